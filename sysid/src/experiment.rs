//! A log as an experiment: windows that are simulated from measured states, and what is compared.

use std::ops::Range;

use glam::DQuat;
use twinstep_logs::{Base, Log, TauSensor};
use twinstep_model::{Command, Ground, Job, Joint, NUM_JOINTS, Placement, RobotModel, RobotStates, Rollout};

use crate::motion::{DriveClock, JointCommands, MotionError, command, joint_commands};

/// Length of a window with a free trunk [s]; with a held one a window is a whole part of the log.
pub const FLOATING_WINDOW_S: f64 = 0.5;
/// Rows this long apart [s] count as independent.
const BLOCK_S: f64 = 0.5;
/// Height at which a held trunk hangs [m].
const HELD_HEIGHT: f32 = twinstep_model::HELD_HEIGHT as f32;

/// Noise that is assumed of a channel whose noise nobody stated: of a quantity, its σ.
const ASSUMED_NOISE: [(&str, f64); 7] =
    [("q", 0.002), ("dq", 0.05), ("tau_measured", 0.2), ("pos", 0.005), ("quat", 0.01), ("vel", 0.05), ("gyro", 0.02)];

/// Why a log is no experiment.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// Its commands cannot be given to the robot.
    #[error(transparent)]
    Motion(#[from] MotionError),
    /// A free trunk's motion was not measured.
    #[error("segment `{segment}` has base \"floating\", but the log has no `{missing}`: a window cannot start there")]
    NoBase {
        /// The segment's name.
        segment: String,
        /// The channels that are missing.
        missing: &'static str,
    },
    /// Segments of both kinds.
    #[error("the log has segments with base \"fixed\" and with base \"floating\"\n  give them as two logs")]
    BothBases,
}

/// What is compared in every row.
#[derive(Clone, Debug)]
struct Channel {
    quantity: Quantity,
    /// Standard deviation of its noise, in its unit.
    sigma: f64,
    /// Measured, by row; a missing cell is NaN.
    measured: Vec<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Quantity {
    Position(usize),
    Velocity(usize),
    Torque(usize),
    BasePosition(usize),
    /// A component of the rotation vector from the measured to the simulated orientation.
    BaseOrientation(usize),
    BaseVelocity(usize),
    BaseRate(usize),
}

/// Rows that are simulated from the first of them.
#[derive(Clone, Debug)]
struct Window {
    rows: Range<usize>,
    start: Placement,
    /// One a drive period.
    commands: Vec<Command>,
    /// For every row, the drive period at whose start it was sampled.
    period: Vec<usize>,
}

/// A log cut into windows.
#[derive(Clone, Debug)]
pub struct Experiment {
    /// Whether the trunk was free.
    pub floating: bool,
    windows: Vec<Window>,
    channels: Vec<Channel>,
    /// Measured orientations, by row, where the trunk was free.
    orientations: Vec<DQuat>,
    /// The log's own joints.
    joints: Vec<Joint>,
    /// Rows in half a second.
    rows_a_block: usize,
}

impl Experiment {
    /// `log` as an experiment on robots like `robot`: a held trunk from each part's start to its end, a free one in windows
    /// of half a second. Voltage and temperature weaken the motors as `robot` says.
    pub fn new(log: &Log, robot: &RobotModel) -> Result<Self, ExperimentError> {
        let commands = joint_commands(log)?;
        let clock = DriveClock::of(log, robot)?;
        let floating = floating(log)?;
        let joints: Vec<_> = commands.iter().map(|joint| joint.joint).collect();
        let player = Player { log, robot, commands, clock, floating };
        let rows_a_block = ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1);
        let mut windows = Vec::new();
        for (_, rows) in log.segments() {
            let length = if floating { (FLOATING_WINDOW_S * log.meta().rate_hz).round() as usize } else { rows.len() };
            let mut first = rows.start;
            while first + 1 < rows.end {
                let end = (first + length + 1).min(rows.end);
                windows.push(player.window(first..end));
                first = end - 1;
            }
        }
        let orientations =
            if floating { (0..log.rows()).map(|row| player.orientation(row)).collect() } else { Vec::new() };
        Ok(Self { floating, windows, channels: channels(log, &joints, floating), orientations, joints, rows_a_block })
    }

    /// The joints that the log has.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// The experiment with the rows `keep` says yes to alone.
    #[must_use]
    pub fn only(mut self, keep: impl Fn(usize) -> bool) -> Self {
        for channel in &mut self.channels {
            for (row, cell) in channel.measured.iter_mut().enumerate() {
                if !keep(row) {
                    *cell = f64::NAN;
                }
            }
        }
        for window in &mut self.windows {
            // What is not compared is not simulated: a window ends with its last row that counts.
            let last = window.rows.clone().rev().find(|row| keep(*row)).unwrap_or(window.rows.start);
            let count = last + 1 - window.rows.start;
            window.rows.end = last + 1;
            window.period.truncate(count);
            window.commands.truncate(window.period[count - 1] + 1);
        }
        self.windows.retain(|window| window.rows.len() > 1);
        self
    }

    /// Differences of simulated and measured for each candidate, in units of their noise; one entry a cell that was
    /// measured, in the same order for every candidate. Not finite from where a candidate diverges.
    pub fn residuals(&self, simulator: &mut dyn Rollout, candidates: &[RobotModel]) -> Vec<Vec<f64>> {
        let trajectories = self.play(simulator, candidates);
        candidates
            .iter()
            .zip(trajectories.chunks(self.windows.len().max(1)))
            .map(|(robot, windows)| {
                let mut residuals = Vec::new();
                for (channel, window, states) in self.compared(windows) {
                    self.compare(channel, window, states, robot, |_, difference| {
                        residuals.push(difference / channel.sigma);
                    });
                }
                residuals
            })
            .collect()
    }

    /// For every residual, the block of half a second that it belongs to.
    pub fn blocks(&self) -> Vec<usize> {
        let mut blocks = Vec::new();
        for channel in &self.channels {
            for window in &self.windows {
                let end = window.rows.end - usize::from(matches!(channel.quantity, Quantity::Torque(_)));
                let rows = (window.rows.start + 1..end).filter(|row| channel.measured[*row].is_finite());
                blocks.extend(rows.map(|row| row / self.rows_a_block));
            }
        }
        blocks
    }

    /// Simulated less measured position of each joint [rad] with its row, simulated from measured states.
    pub fn position_errors(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> [Vec<(usize, f64)>; NUM_JOINTS] {
        let windows = self.play(simulator, std::slice::from_ref(robot));
        let mut errors = [const { Vec::new() }; NUM_JOINTS];
        for (channel, window, states) in self.compared(&windows) {
            if let Quantity::Position(joint) = channel.quantity {
                self.compare(channel, window, states, robot, |row, difference| errors[joint].push((row, difference)));
            }
        }
        errors
    }

    fn play(&self, simulator: &mut dyn Rollout, candidates: &[RobotModel]) -> Vec<RobotStates> {
        let jobs: Vec<_> = candidates
            .iter()
            .flat_map(|robot| {
                self.windows.iter().map(move |window| {
                    // Where the gyroscope is off, so is the measured start.
                    let mut start = window.start;
                    for (rate, bias) in start.base_angular_velocity.iter_mut().zip(robot.gyro_bias.to_array()) {
                        *rate -= bias as f32;
                    }
                    Job { robot, start, commands: &window.commands }
                })
            })
            .collect();
        simulator.play(&jobs)
    }

    fn compared<'a>(
        &'a self,
        windows: &'a [RobotStates],
    ) -> impl Iterator<Item = (&'a Channel, &'a Window, &'a RobotStates)> {
        self.channels.iter().flat_map(move |channel| {
            self.windows.iter().zip(windows).map(move |(window, states)| (channel, window, states))
        })
    }

    /// Hands on the difference in each row of a window but its first, which was given.
    fn compare(
        &self,
        channel: &Channel,
        window: &Window,
        states: &RobotStates,
        robot: &RobotModel,
        mut each: impl FnMut(usize, f64),
    ) {
        for (index, row) in window.rows.clone().enumerate().skip(1) {
            let measured = channel.measured[row];
            if !measured.is_finite() {
                continue;
            }
            let period = window.period[index];
            if matches!(channel.quantity, Quantity::Torque(_)) && row + 1 == window.rows.end {
                // The mean to the next row: there is none.
                continue;
            }
            let simulated = match channel.quantity {
                Quantity::Position(joint) => f64::from(states.q[period][joint]),
                Quantity::Velocity(joint) => f64::from(states.dq[period][joint]),
                Quantity::Torque(joint) => {
                    let until = window.period.get(index + 1).copied().unwrap_or(period + 1);
                    shown_torque(states, robot, joint, period, until)
                }
                Quantity::BasePosition(axis) => f64::from(states.base_position[period][axis]),
                Quantity::BaseOrientation(axis) => {
                    let [w, x, y, z] = states.base_orientation[period].map(f64::from);
                    let turn = self.orientations[row].inverse() * DQuat::from_xyzw(x, y, z, w);
                    let turn = if turn.w < 0.0 { -turn } else { turn };
                    turn.to_scaled_axis()[axis]
                }
                Quantity::BaseVelocity(axis) => f64::from(states.base_linear_velocity[period][axis]),
                Quantity::BaseRate(axis) => f64::from(states.base_angular_velocity[period][axis]),
            };
            each(row, simulated - measured);
        }
    }
}

/// Mean torque over drive periods `from..until`, as a late sensor shows it [N·m].
fn shown_torque(states: &RobotStates, robot: &RobotModel, joint: usize, from: usize, until: usize) -> f64 {
    let late = robot.joints[joint].drive.sensor_delay / robot.control.drive_dt();
    // Entry p + 1 holds the torque of period p.
    let at = |period: f64| {
        let entry = (period + 1.0).clamp(1.0, (states.tau.len() - 1) as f64);
        let (whole, part) = (entry.floor() as usize, entry.fract());
        let next = (whole + 1).min(states.tau.len() - 1);
        f64::from(states.tau[whole][joint]) * (1.0 - part) + f64::from(states.tau[next][joint]) * part
    };
    let periods = until.max(from + 1) - from;
    (0..periods).map(|index| at((from + index) as f64 - late)).sum::<f64>() / periods as f64
}

fn floating(log: &Log) -> Result<bool, ExperimentError> {
    let (mut fixed, mut free) = (false, None);
    for (segment, _) in log.segments() {
        match segment.base {
            Base::Fixed => fixed = true,
            Base::Floating => free = Some(segment),
        }
    }
    let Some(segment) = free else { return Ok(false) };
    if fixed {
        return Err(ExperimentError::BothBases);
    }
    for missing in ["pos_z", "quat_w", "vel_x"] {
        if log.channel(missing).is_none() {
            return Err(ExperimentError::NoBase { segment: segment.name.clone(), missing });
        }
    }
    Ok(true)
}

fn channels(log: &Log, joints: &[Joint], floating: bool) -> Vec<Channel> {
    let mut channels = Vec::new();
    let mut add = |quantity: Quantity, name: String, kind: &str, measured: Option<&[f64]>| {
        let assumed = ASSUMED_NOISE.iter().find(|(quantity, _)| *quantity == kind).expect("a known kind").1;
        if let Some(measured) = measured {
            let sigma = log.noise(&name).filter(|sigma| *sigma > 0.0).unwrap_or(assumed);
            channels.push(Channel { quantity, sigma, measured: measured.to_vec() });
        }
    };
    for joint in joints {
        let (index, name) = (joint.index(), joint.name());
        add(Quantity::Position(index), format!("q_{name}"), "q", log.q(name));
        add(Quantity::Velocity(index), format!("dq_{name}"), "dq", log.dq(name));
        if log.meta().tau_sensor == TauSensor::Current {
            add(Quantity::Torque(index), format!("tau_measured_{name}"), "tau_measured", log.tau_measured(name));
        }
    }
    if floating {
        let known = |row: usize| {
            ["w", "x", "y", "z"]
                .iter()
                .all(|part| log.channel(&format!("quat_{part}")).is_some_and(|cells| cells[row].is_finite()))
        };
        let zeros: Vec<f64> = (0..log.rows()).map(|row| if known(row) { 0.0 } else { f64::NAN }).collect();
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            let of = |kind: &str| format!("{kind}_{letter}");
            add(Quantity::BasePosition(axis), of("pos"), "pos", log.channel(&of("pos")));
            add(Quantity::BaseOrientation(axis), "quat_w".to_owned(), "quat", Some(&zeros));
            add(Quantity::BaseVelocity(axis), of("vel"), "vel", log.channel(&of("vel")));
            add(Quantity::BaseRate(axis), of("gyro"), "gyro", log.channel(&of("gyro")));
        }
    }
    channels
}

/// A log whose parts become windows.
struct Player<'a> {
    log: &'a Log,
    robot: &'a RobotModel,
    commands: Vec<JointCommands<'a>>,
    clock: DriveClock,
    floating: bool,
}

impl Player<'_> {
    fn window(&self, rows: Range<usize>) -> Window {
        let t = &self.log.t()[rows.clone()];
        let (mut commands, mut period) = (Vec::new(), Vec::new());
        for (index, row) in rows.clone().enumerate() {
            period.push(commands.len());
            if row + 1 < rows.end {
                let mut command = command(self.robot, &self.commands, row);
                command.strength = strength(self.log, self.robot, row);
                commands.extend(std::iter::repeat_n(command, self.clock.periods_between(t, index)));
            }
        }
        Window { start: self.start(rows.clone()), rows, commands, period }
    }

    fn start(&self, rows: Range<usize>) -> Placement {
        let mut start = Placement::above(&Ground::FLAT, self.robot, self.robot.control.default_pose_f32(), 0.0);
        if !self.floating {
            start = Placement::at_rest(HELD_HEIGHT, self.robot.control.default_pose_f32());
        }
        let row = rows.start;
        for joint in &self.commands {
            let (index, name) = (joint.joint.index(), joint.joint.name());
            let q = self.log.q(name).expect("every joint of a log has its position");
            start.q[index] = q[row] as f32;
            start.dq[index] = match self.log.dq(name).map(|dq| dq[row]).filter(|dq| dq.is_finite()) {
                Some(dq) => dq as f32,
                None => slope(&self.log.t()[rows.clone()], &q[rows.clone()]) as f32,
            };
        }
        if self.floating {
            let vector = |kind: &str| {
                ["x", "y", "z"].map(|axis| {
                    let cells = self.log.channel(&format!("{kind}_{axis}"));
                    cells.map(|cells| cells[row]).filter(|cell| cell.is_finite()).unwrap_or(0.0) as f32
                })
            };
            let DQuat { x, y, z, w } = self.orientation(row);
            start.base_orientation = [w, x, y, z].map(|part| part as f32);
            start.base_position = vector("pos");
            start.base_linear_velocity = vector("vel");
            start.base_angular_velocity = vector("gyro");
        }
        start
    }

    fn orientation(&self, row: usize) -> DQuat {
        let [w, x, y, z] = ["w", "x", "y", "z"]
            .map(|part| self.log.channel(&format!("quat_{part}")).map_or(f64::NAN, |cells| cells[row]));
        let turn = DQuat::from_xyzw(x, y, z, w);
        if turn.is_finite() && turn.length() > 0.5 { turn.normalize() } else { DQuat::IDENTITY }
    }
}

/// What supply and heat leave of each joint's torque in a row.
pub fn strength(log: &Log, robot: &RobotModel, row: usize) -> [f32; NUM_JOINTS] {
    let voltage = log.channel("battery_V").map_or(1.0, |cells| {
        let highest = cells.iter().copied().filter(|cell| cell.is_finite()).fold(f64::MIN_POSITIVE, f64::max);
        if cells[row].is_finite() { cells[row] / highest } else { 1.0 }
    });
    std::array::from_fn(|joint| {
        let temperature = log.channel(&format!("temp_{}", Joint::ALL[joint])).map_or(f64::NAN, |cells| cells[row]);
        robot.derating.strength(joint, voltage, temperature) as f32
    })
}

/// Velocity at the start of a part whose velocities were not measured: the slope of a line through its first samples.
fn slope(t: &[f64], q: &[f64]) -> f64 {
    const SAMPLES: usize = 4;
    let count = t.len().min(SAMPLES);
    let mean = |values: &[f64]| values[..count].iter().sum::<f64>() / count as f64;
    let (mean_t, mean_q) = (mean(t), mean(q));
    let (mut over, mut under) = (0.0, 0.0);
    for (t, q) in t.iter().zip(q).take(count) {
        over += (t - mean_t) * (q - mean_q);
        under += (t - mean_t).powi(2);
    }
    if under > 0.0 { over / under } else { 0.0 }
}
