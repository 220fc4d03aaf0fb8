//! A log cut into windows that are simulated from measured states.

use std::ops::Range;

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use twinstep_model::{BaseMount, Command, Ground, HistoryStep, InitialState, RobotModel};
use twinstep_logs::Log;

use crate::experiment::ExperimentError;
use crate::motion::{ActuatorClock, JointCommands, command, joint_commands};

/// The windows that a log is cut into.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowConfig {
    /// Length of a window with a floating base [s].
    pub floating_length_s: f64,
    /// Length of one with a fixed base [s]; infinite for a whole part of the log.
    pub fixed_length_s: f64,
    /// Beginning of a window with a floating base that is not compared [s].
    pub floating_burn_in_s: f64,
    /// And of one with a fixed base [s].
    pub fixed_burn_in_s: f64,
}

impl WindowConfig {
    /// Every row but a window's first counts.
    pub const EVALUATION: Self = Self { floating_length_s: 0.5, fixed_length_s: f64::INFINITY, floating_burn_in_s: 0.0, fixed_burn_in_s: 0.0 };
    /// The error of a measured start, a millimetre that the feet are in the ground or above it, dies away before anything is
    /// compared: it would pass for a harder ground and a lighter robot.
    pub const IDENTIFICATION: Self =
        Self { floating_length_s: 1.0, fixed_length_s: f64::INFINITY, floating_burn_in_s: 0.2, fixed_burn_in_s: 0.2 };
    /// With windows for a fixed base too: a loop that rings is out of step after a second or two, whatever the model.
    pub const DIAGNOSIS: Self = Self { fixed_length_s: 2.0, ..Self::IDENTIFICATION };
    /// And where the model's does not ring at all, only what is nearly right would stay in step for as long.
    pub const SHORT: Self = Self { fixed_length_s: 0.25, fixed_burn_in_s: 0.0, ..Self::IDENTIFICATION };
}

/// Rows before a window's start that its actuators remember.
const HISTORY_ROWS: usize = 8;
/// Height at which a fixed base hangs [m].
const HELD_HEIGHT: f32 = twinstep_model::FIXED_BASE_HEIGHT as f32;

/// Rows that are simulated from the first of them.
#[derive(Clone, Debug)]
pub struct Window {
    /// The rows.
    pub rows: Range<usize>,
    /// Whether the base was fixed.
    pub held: bool,
    /// The first row's measured state.
    pub start: InitialState,
    /// What was measured in the actuator periods before it, the oldest first: an actuator that acts late knows it still.
    pub history: Vec<HistoryStep>,
    /// One an actuator period.
    pub commands: Vec<Command>,
    /// Rows at its beginning that are not compared.
    pub settling: usize,
    /// For every row, the actuator period at whose start it was sampled.
    pub period: Vec<usize>,
}

impl Window {
    /// Moves the start by `error`: of position, orientation, velocity or rate, in this order, along or about an axis.
    pub fn perturb_start(&mut self, quantity: usize, axis: usize, error: f64) {
        match quantity {
            0 => self.start.base_position[axis] += error as f32,
            1 => {
                let [w, x, y, z] = self.start.base_orientation.map(f64::from);
                let turn = DQuat::from_scaled_axis(DVec3::AXES[axis] * error);
                let DQuat { x, y, z, w } = DQuat::from_xyzw(x, y, z, w) * turn;
                self.start.base_orientation = [w, x, y, z].map(|part| part as f32);
            }
            2 => self.start.base_linear_velocity[axis] += error as f32,
            _ => self.start.base_angular_velocity[axis] += error as f32,
        }
    }
}

/// Cuts `log`: a fixed base from each part's start to its end, a free one in windows of a horizon.
pub fn windows(log: &Log, robot: &RobotModel, horizon: WindowConfig) -> Result<Vec<Window>, ExperimentError> {
    let player = WindowBuilder { log, robot, commands: joint_commands(log)?, clock: ActuatorClock::of(log, robot)? };
    let mut windows = Vec::new();
    for (segment, rows) in log.segments() {
        let held = segment.base == BaseMount::Fixed;
        if !held
            && let Some(missing) = ["pos_z", "quat_w", "vel_x"].into_iter().find(|name| log.channel(name).is_none())
        {
            return Err(ExperimentError::MissingBaseState { segment: segment.name.clone(), missing });
        }
        let in_rows = |time_s: f64| (time_s * log.meta().rate_hz).round() as usize;
        let whole = held && horizon.fixed_length_s.is_infinite();
        let length = if whole { rows.len() } else { in_rows(if held { horizon.fixed_length_s } else { horizon.floating_length_s }) };
        let settling =
            if whole { 1 } else { in_rows(if held { horizon.fixed_burn_in_s } else { horizon.floating_burn_in_s }).max(1) };
        let mut first = rows.start;
        while first + 1 < rows.end {
            let end = (first + length + 1).min(rows.end);
            windows.push(Window { settling, ..player.window(&rows, first..end, held) });
            first = end - 1;
        }
    }
    Ok(windows)
}

/// Measured orientation of the trunk, world from base.
pub fn orientation(log: &Log, row: usize) -> DQuat {
    let [w, x, y, z] =
        ["w", "x", "y", "z"].map(|part| log.channel(&format!("quat_{part}")).map_or(f64::NAN, |cells| cells[row]));
    normalized([w, x, y, z])
}

/// None turned at all where it was not measured.
fn normalized([w, x, y, z]: [f64; 4]) -> DQuat {
    let turn = DQuat::from_xyzw(x, y, z, w);
    if turn.is_finite() && turn.length() > 0.5 { turn.normalize() } else { DQuat::IDENTITY }
}

/// A log whose parts become windows.
struct WindowBuilder<'a> {
    log: &'a Log,
    robot: &'a RobotModel,
    commands: Vec<JointCommands<'a>>,
    clock: ActuatorClock,
}

impl WindowBuilder<'_> {
    fn window(&self, part: &Range<usize>, rows: Range<usize>, held: bool) -> Window {
        let t = &self.log.t()[rows.clone()];
        let (mut commands, mut period) = (Vec::new(), Vec::new());
        for (index, row) in rows.clone().enumerate() {
            period.push(commands.len());
            if row + 1 < rows.end {
                let command = command(self.robot, &self.commands, row);
                commands.extend(std::iter::repeat_n(command, self.clock.periods_between(t, index)));
            }
        }
        let (start, past) = (self.start(part, rows.start, held), self.past(part, rows.start, held));
        Window { held, settling: 1, start, history: past, rows, commands, period }
    }

    /// The actuator periods before `first`, as far as the part goes back.
    fn past(&self, part: &Range<usize>, first: usize, held: bool) -> Vec<HistoryStep> {
        let from = first.saturating_sub(HISTORY_ROWS).max(part.start);
        let t = &self.log.t()[from..=first];
        let of_row = |row: usize| {
            let InitialState { q, dq, .. } = self.start(part, row, held);
            let past = HistoryStep { command: command(self.robot, &self.commands, row), q, dq };
            std::iter::repeat_n(past, self.clock.periods_between(t, row - from))
        };
        (from..first).flat_map(of_row).collect()
    }

    /// The state in `row` of a part.
    fn start(&self, part: &Range<usize>, row: usize, held: bool) -> InitialState {
        let mut start = InitialState::standing_on(&Ground::FLAT, self.robot, self.robot.control.default_pose_f32(), 0.0);
        if held {
            start = InitialState::at_rest(HELD_HEIGHT, self.robot.control.default_pose_f32());
        }
        let smoothed = |cells: &[f64]| smoothed(&self.log.t()[part.clone()], &cells[part.clone()], row - part.start);
        for joint in &self.commands {
            let (index, name) = (joint.joint.index(), joint.joint.name());
            let [q, slope] = smoothed(self.log.q(name).expect("every joint of a log has its position"));
            start.q[index] = q as f32;
            let dq = self.log.dq(name).map(|dq| smoothed(dq)[0]).filter(|dq| dq.is_finite());
            start.dq[index] = dq.unwrap_or(slope) as f32;
        }
        if !held {
            let vector = |kind: &str| {
                ["x", "y", "z"].map(|axis| {
                    let cells = self.log.channel(&format!("{kind}_{axis}"));
                    cells.map(|cells| smoothed(cells)[0]).filter(|cell| cell.is_finite()).unwrap_or(0.0) as f32
                })
            };
            // Neighbouring orientations are close: their parts may be smoothed one by one.
            let parts = ["w", "x", "y", "z"]
                .map(|part| self.log.channel(&format!("quat_{part}")).map_or(f64::NAN, |cells| smoothed(cells)[0]));
            let DQuat { x, y, z, w } = normalized(parts);
            start.base_orientation = [w, x, y, z].map(|part| part as f32);
            start.base_position = vector("pos");
            start.base_linear_velocity = vector("vel");
            start.base_angular_velocity = vector("gyro");
        }
        start
    }
}

/// Value and slope at `row` of the parabola through the cells within 20 ms of it: sensors are noisy, and a simulation
/// carries the error of its start along. Not a number where the cell itself is missing.
fn smoothed(t: &[f64], cells: &[f64], row: usize) -> [f64; 2] {
    let near = (0..cells.len()).filter(|other| (t[*other] - t[row]).abs() < 0.0201 && cells[*other].is_finite());
    let near: Vec<_> = near.map(|other| (t[other] - t[row], cells[other])).collect();
    if !cells[row].is_finite() {
        return [f64::NAN; 2];
    }
    // Two cells have a line, one has itself.
    let order = near.len().min(3);
    let power = |t: f64, column: usize| t.powi(column as i32);
    let design = DMatrix::from_fn(near.len(), order, |row, column| power(near[row].0 / 0.02, column));
    let values = DVector::from_iterator(near.len(), near.iter().map(|(_, value)| *value));
    let solved = (design.transpose() * &design).cholesky().map(|factor| factor.solve(&(design.transpose() * values)));
    solved.map_or([cells[row], 0.0], |fit| [fit[0], fit.get(1).map_or(0.0, |slope| slope / 0.02)])
}
