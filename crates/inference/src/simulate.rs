//! Simulation of candidates in the windows of a log.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use twinstep_model::{BaseMount, TreeModel};
use twinstep_sim::{SimConfig, SimdPrecision, TreeCommand, TreeSimulation};

use crate::{Candidate, InferenceError, JointLog, Window};

/// Robots that one core simulates together: full lanes, and few enough for its cache.
const TOGETHER: usize = 64;

/// Simulated signals in a window: one list for each joint of the log, with one entry for each row.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// Encoder reading at the row [rad].
    pub q: Vec<Vec<f64>>,
    /// Torque of the motor current, mean from the row to the next [N·m]; NaN in the last row.
    pub tau: Vec<Vec<f64>>,
}

/// Simulates each candidate in each window, in double precision, with actuators of the rate `actuator_hz` [Hz].
///
/// Ends with [`InferenceError::Interrupted`] soon after `stop` is true. The base is fixed, the robot touches nothing, and joint ranges include the measured positions. Commands arrive after their delay: the
/// commands of the log are shifted, so a delay may be of any length.
pub fn simulate(
    log: &JointLog,
    windows: &[Window],
    candidates: &[Candidate],
    actuator_hz: f64,
    stop: &AtomicBool,
) -> Result<Vec<Vec<Trace>>, InferenceError> {
    let clocks: Vec<_> = windows.iter().map(|window| Clock::new(log, window, actuator_hz)).collect();
    let robots: Vec<_> = candidates.iter().map(|candidate| in_the_air(&candidate.robot, log)).collect();
    let jobs: Vec<Job> = (0..candidates.len())
        .flat_map(|candidate| windows.iter().zip(&clocks).map(move |(window, clock)| (candidate, window, clock)))
        .map(|(index, window, clock)| Job { log, robot: &robots[index], candidate: &candidates[index], window, clock })
        .collect();
    let lanes = SimdPrecision::Double.lanes();
    let together = jobs.len().div_ceil(rayon::current_num_threads()).next_multiple_of(lanes).clamp(lanes, TOGETHER);
    let groups: Vec<_> =
        jobs.par_chunks(together).map(|jobs| run(jobs, actuator_hz, stop)).collect::<Result<_, _>>()?;
    let mut traces = groups.into_iter().flatten();
    Ok(candidates.iter().map(|_| traces.by_ref().take(windows.len()).collect()).collect())
}

/// One candidate in one window.
struct Job<'a> {
    log: &'a JointLog,
    robot: &'a TreeModel,
    candidate: &'a Candidate,
    window: &'a Window,
    clock: &'a Clock,
}

/// Returns the robot as it hangs: without contacts, with commands that arrive at once, and with ranges around the measured positions.
fn in_the_air(robot: &TreeModel, log: &JointLog) -> TreeModel {
    let mut robot = robot.clone();
    robot.points.clear();
    for joint in &mut robot.joints {
        joint.actuator.command_delay = 0.0;
    }
    for channels in &log.joints {
        let [low, high] = &mut robot.joints[channels.joint].range;
        for q in channels.q.iter().filter(|q| q.is_finite()) {
            (*low, *high) = (low.min(*q), high.max(*q));
        }
    }
    robot
}

fn run(jobs: &[Job], actuator_hz: f64, stop: &AtomicBool) -> Result<Vec<Trace>, InferenceError> {
    let config = SimConfig { base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let first = &jobs[0];
    let mut simulation = TreeSimulation::with_precision(
        first.robot,
        &config,
        actuator_hz,
        SimdPrecision::Double,
        jobs.len(),
        &first.window.start,
    )?;
    let mut commands: Vec<_> = jobs.iter().map(Job::hold).collect();
    let mut traces: Vec<_> = jobs.iter().map(Job::trace).collect();
    for (robot, job) in jobs.iter().enumerate() {
        simulation.reset(robot, job.robot, &job.window.start)?;
    }
    let periods = jobs.iter().map(|job| job.clock.num_periods()).max().unwrap_or(0);
    for period in 0..periods {
        if stop.load(Ordering::Relaxed) {
            return Err(InferenceError::Interrupted);
        }
        for (job, command) in jobs.iter().zip(&mut commands) {
            job.set_command(period, command);
        }
        simulation.step(&commands, 1)?;
        for ((job, trace), readings) in jobs.iter().zip(&mut traces).zip(simulation.states()) {
            job.record(period, &readings.state.q, &readings.tau, trace);
        }
    }
    Ok(traces)
}

impl Job<'_> {
    /// Returns the command that holds the initial position, for the joints that the log lacks.
    fn hold(&self) -> TreeCommand {
        let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<_>>();
        let command = TreeCommand::hold(single(&self.window.start.q), 0.0, 0.0);
        TreeCommand { kp: single(&self.candidate.kp), kd: single(&self.candidate.kd), ..command }
    }

    fn trace(&self) -> Trace {
        let rows = self.window.rows.len();
        let mut trace = Trace {
            q: vec![vec![0.0; rows]; self.log.joints.len()],
            tau: vec![vec![0.0; rows]; self.log.joints.len()],
        };
        for (index, channels) in self.log.joints.iter().enumerate() {
            trace.q[index][0] = self.window.start.q[channels.joint];
            trace.tau[index][rows - 1] = f64::NAN;
        }
        trace
    }

    /// Sets the command of an actuator period. After the window the last one is held.
    fn set_command(&self, period: usize, command: &mut TreeCommand) {
        let period = period.min(self.clock.num_periods() - 1);
        for channels in &self.log.joints {
            let joint = channels.joint;
            let delay = self.candidate.robot.joints[joint].actuator.command_delay;
            let [(early, before), (late, after)] = self.clock.arriving(period, delay);
            // Before the range the robot was held where it is.
            let mix = |cells: &[f64], held: f64| {
                let cell = |row: Option<usize>| row.map_or(held, |row| cells[row]);
                (early * cell(before) + late * cell(after)) as f32
            };
            command.q[joint] = mix(&channels.q_cmd, self.window.start.q[joint]);
            command.dq[joint] = mix(&channels.dq_cmd, 0.0);
            command.tau_ff[joint] = mix(&channels.tau_ff, 0.0);
            // Gains are those of the drive; they are not sent with the command.
            let row = self.window.rows.start + self.clock.row_of_period[period];
            for (gain, given) in [(&mut command.kp, &channels.kp), (&mut command.kd, &channels.kd)] {
                if let Some(given) = given {
                    gain[joint] = given[row] as f32;
                }
            }
        }
    }

    /// Records the readings at the end of an actuator period.
    fn record(&self, period: usize, q: &[f64], tau: &[f64], trace: &mut Trace) {
        if period >= self.clock.num_periods() {
            return;
        }
        let row = self.clock.row_of_period[period];
        let length = self.clock.sample[row + 1] - self.clock.sample[row];
        let ends = self.clock.sample[row + 1] == period + 1;
        for (index, channels) in self.log.joints.iter().enumerate() {
            trace.tau[index][row] += tau[channels.joint] / length as f64;
            if ends {
                trace.q[index][row + 1] = q[channels.joint];
            }
        }
    }
}

/// Actuator periods of a window, counted from its first row.
struct Clock {
    /// Actuator period at whose start each row was sampled.
    sample: Vec<usize>,
    /// Row of the window whose interval contains each period.
    row_of_period: Vec<usize>,
    /// Row of the log whose command is sent in each period, from `-history`; `None` before the contiguous range.
    command_row: Vec<Option<usize>>,
    /// Number of periods before the window.
    history: usize,
    rate_hz: f64,
}

impl Clock {
    /// Longest delay of a command [s].
    const HISTORY_S: f64 = 0.25;

    fn new(log: &JointLog, window: &Window, rate_hz: f64) -> Self {
        let (t, start) = (&log.t, log.t[window.rows.start]);
        let mut sample: Vec<_> = window.rows.clone().map(|row| ((t[row] - start) * rate_hz).round() as usize).collect();
        // Rows within one actuator period are one period apart.
        for row in 1..sample.len() {
            sample[row] = sample[row].max(sample[row - 1] + 1);
        }
        let row_of_period: Vec<_> =
            sample.windows(2).enumerate().flat_map(|(row, pair)| std::iter::repeat_n(row, pair[1] - pair[0])).collect();
        let history = (Self::HISTORY_S * rate_hz).ceil() as usize;
        let sent = |periods_before: usize| {
            let time = start - periods_before as f64 / rate_hz + 1e-9;
            let rows = &t[window.range_start..window.rows.start];
            rows.partition_point(|t| *t <= time).checked_sub(1).map(|row| window.range_start + row)
        };
        let mut command_row: Vec<_> = (1..=history).rev().map(sent).collect();
        command_row.extend(row_of_period.iter().map(|row| Some(window.rows.start + row)));
        Self { sample, row_of_period, command_row, history, rate_hz }
    }

    fn num_periods(&self) -> usize {
        self.row_of_period.len()
    }

    /// Returns the row whose command was sent in a period, which may be before the window.
    fn row_at(&self, period: isize) -> Option<usize> {
        self.command_row[(period + self.history as isize).max(0) as usize]
    }

    /// Returns shares and rows of the commands that arrive in a period after a delay [s].
    fn arriving(&self, period: usize, delay: f64) -> [(f64, Option<usize>); 2] {
        let age = delay * self.rate_hz;
        let (whole, part) = (age.floor(), age.fract());
        let sent = period as isize - whole as isize;
        [(1.0 - part, self.row_at(sent)), (part, self.row_at(sent - 1))]
    }
}
