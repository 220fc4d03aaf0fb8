//! Windows of a log, which are simulated from measured states.

use std::ops::Range;

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use twinstep_logs::Log;
use twinstep_model::{
    ActuatorParams, BaseMount, Command, Ground, HistoryStep, InitialState, Joint, NUM_JOINTS, RobotModel,
};

use crate::base_estimate::BaseEstimate;
use crate::error::ExperimentError;
use crate::orientation::normalized;
use twinstep_logs::replay::{ActuatorClock, JointCommands, check_gains, command, joint_commands};

/// Lengths of the windows of a log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowConfig {
    /// Length of windows with a floating base [s].
    pub floating_length_s: f64,
    /// Length of windows with a fixed base [s]; infinite for whole contiguous ranges of rows.
    pub fixed_length_s: f64,
    /// Burn-in of windows with a floating base, which is not compared [s].
    pub floating_burn_in_s: f64,
    /// Burn-in of windows with a fixed base [s].
    pub fixed_burn_in_s: f64,
}

impl WindowConfig {
    /// Windows for evaluation: every row except the first of a window is compared.
    pub const EVALUATION: Self =
        Self { floating_length_s: 0.5, fixed_length_s: f64::INFINITY, floating_burn_in_s: 0.0, fixed_burn_in_s: 0.0 };
    /// Windows for identification, with a burn-in in which errors of the initial state decay.
    ///
    /// Without burn-in, an error of a millimetre in the height of the feet is attributed to stiffer ground and a
    /// lighter robot.
    pub const IDENTIFICATION: Self =
        Self { floating_length_s: 1.0, fixed_length_s: f64::INFINITY, floating_burn_in_s: 0.2, fixed_burn_in_s: 0.2 };
    /// 2 s fixed-base windows: an oscillating loop loses phase within 1 to 2 s for any model.
    pub const DIAGNOSIS: Self = Self { fixed_length_s: 2.0, ..Self::IDENTIFICATION };
    /// 0.25 s fixed-base windows, for a model that does not oscillate although the robot does.
    ///
    /// Over longer windows only nearly correct parameters reduce the residual.
    pub const SHORT: Self = Self { fixed_length_s: 0.25, fixed_burn_in_s: 0.0, ..Self::IDENTIFICATION };
}

/// Time before a window whose commands and measurements initialise the actuators' delays and lags [s].
const HISTORY_S: f64 = ActuatorParams::MAX_DELAY;
/// Height of a fixed base [m].
const HELD_HEIGHT: f32 = twinstep_model::FIXED_BASE_HEIGHT as f32;

/// Range of rows that is simulated from its first measured state.
#[derive(Clone, Debug)]
pub struct Window {
    /// Rows of the log.
    pub rows: Range<usize>,
    /// Mount of the base.
    pub base: BaseMount,
    /// Measured state of the first row.
    pub start: InitialState,
    /// Commands and measurements in the actuator periods before the first row, oldest first.
    pub history: Vec<HistoryStep>,
    /// Commands, one per actuator period.
    pub commands: Vec<Command>,
    /// Number of rows of the burn-in.
    pub settling: usize,
    /// True if the base floats and the joints move fast: the robot walks, trots or jumps.
    pub fast: bool,
    /// True if the window is fast, and its residuals are a regime of their own.
    pub dynamic: bool,
    /// Actuator period at whose start each row was sampled.
    pub period: Vec<usize>,
}

impl Window {
    /// Keeps the first `count` rows.
    pub fn truncate(&mut self, count: usize) {
        self.rows.end = self.rows.start + count;
        self.period.truncate(count);
        self.commands.truncate(self.period[count - 1] + 1);
    }

    /// Perturbs the initial state by `error` along or about an axis.
    ///
    /// `quantity` is 0 for position, 1 for orientation, 2 for velocity, 3 for angular velocity.
    pub fn perturb_start(&mut self, quantity: usize, axis: usize, error: f64) {
        match quantity {
            0 => self.start.base_position[axis] += error as f32,
            1 => {
                let [w, x, y, z] = self.start.base_orientation.map(f64::from);
                let rotation = DQuat::from_scaled_axis(DVec3::AXES[axis] * error);
                let DQuat { x, y, z, w } = DQuat::from_xyzw(x, y, z, w) * rotation;
                self.start.base_orientation = [w, x, y, z].map(|part| part as f32);
            }
            2 => self.start.base_linear_velocity[axis] += error as f32,
            _ => self.start.base_angular_velocity[axis] += error as f32,
        }
    }
}

/// Splits `log` into windows.
///
/// Rows in which a robot on the ground only brakes its motors have no window: see [`WindowBuilder::is_limp`].
pub fn windows(log: &Log, robot: &RobotModel, horizon: WindowConfig) -> Result<Vec<Window>, ExperimentError> {
    check_gains(log)?;
    let builder = WindowBuilder {
        log,
        robot,
        commands: joint_commands(log)?,
        clock: ActuatorClock::of(log, robot)?,
        estimate: base_estimate(log, robot)?,
    };
    let mut windows = Vec::new();
    for (segment, rows) in log.segments() {
        let (base, held) = (segment.base, segment.base.is_fixed());
        let in_rows = |time_s: f64| (time_s * log.meta().rate_hz).round() as usize;
        let whole = held && horizon.fixed_length_s.is_infinite();
        let length = if whole {
            rows.len()
        } else {
            in_rows(if held { horizon.fixed_length_s } else { horizon.floating_length_s })
        };
        let settling = if whole {
            1
        } else {
            in_rows(if held { horizon.fixed_burn_in_s } else { horizon.floating_burn_in_s }).max(1)
        };
        for part in builder.simulated_parts(&rows, base) {
            let mut first = part.start;
            while first + 1 < part.end {
                let end = (first + length + 1).min(part.end);
                windows.push(Window { settling, ..builder.window(&rows, first..end, base) });
                first = end - 1;
            }
        }
    }
    if windows.is_empty() {
        return Err(ExperimentError::NothingToSimulate { rows: log.rows() });
    }
    Ok(windows)
}

/// Estimates the motion of a floating base whose height or velocity `log` lacks. Returns `None` if nothing is missing.
pub fn base_estimate(log: &Log, robot: &RobotModel) -> Result<Option<BaseEstimate>, ExperimentError> {
    let floating = log.segments().find(|(segment, _)| !segment.base.is_fixed());
    let Some((segment, _)) = floating else { return Ok(None) };
    let is_measured = ["pos_z", "vel_x"].iter().all(|name| log.channel(name).is_some());
    let positions = Joint::ALL.map(|joint| format!("q_{joint}"));
    let sensors = ["gyro_x"].into_iter().chain(positions.iter().map(String::as_str)).filter(|_| !is_measured);
    match ["quat_w"].into_iter().chain(sensors).find(|name| log.channel(name).is_none()) {
        Some(missing) => {
            Err(ExperimentError::MissingBaseState { segment: segment.name.clone(), missing: missing.to_owned() })
        }
        None => Ok((!is_measured).then(|| BaseEstimate::of(log, robot))),
    }
}

/// Builder of windows from a log.
struct WindowBuilder<'a> {
    log: &'a Log,
    robot: &'a RobotModel,
    commands: Vec<JointCommands<'a>>,
    clock: ActuatorClock,
    /// Motion of a floating base that was not measured.
    estimate: Option<BaseEstimate>,
}

impl WindowBuilder<'_> {
    /// Returns the parts of a contiguous range that are simulated.
    fn simulated_parts(&self, rows: &Range<usize>, base: BaseMount) -> Vec<Range<usize>> {
        if base.is_fixed() {
            return vec![rows.clone()];
        }
        let all: Vec<usize> = rows.clone().filter(|row| !self.is_limp(*row)).collect();
        all.chunk_by(|one, next| one + 1 == *next).map(|part| part[0]..part[part.len() - 1] + 1).collect()
    }

    /// Returns true if no motor holds a position or has a feed-forward torque.
    ///
    /// Then a robot on the ground slowly folds its legs. The speed depends on how the feet stick, which is not measured.
    fn is_limp(&self, row: usize) -> bool {
        let Command { kp, tau_ff, .. } = command(self.robot, &self.commands, row);
        kp == [0.0; NUM_JOINTS] && tau_ff == [0.0; NUM_JOINTS]
    }

    fn window(&self, range: &Range<usize>, rows: Range<usize>, base: BaseMount) -> Window {
        let t = &self.log.t()[rows.clone()];
        let (mut commands, mut period) = (Vec::new(), Vec::new());
        for (index, row) in rows.clone().enumerate() {
            period.push(commands.len());
            if row + 1 < rows.end {
                let command = command(self.robot, &self.commands, row);
                commands.extend(std::iter::repeat_n(command, self.clock.periods_between(t, index)));
            }
        }
        let (start, history) = (self.start(range, rows.start, base), self.history(range, rows.start, base));
        Window { base, settling: 1, fast: false, dynamic: false, start, history, rows, commands, period }
    }

    /// Returns the actuator periods before `first`, at most to the start of the contiguous range.
    fn history(&self, range: &Range<usize>, first: usize, base: BaseMount) -> Vec<HistoryStep> {
        let from = first.saturating_sub((HISTORY_S * self.log.meta().rate_hz - 1e-6).ceil() as usize).max(range.start);
        let t = &self.log.t()[from..=first];
        let of_row = |row: usize| {
            let InitialState { q, dq, .. } = self.start(range, row, base);
            let step = HistoryStep { command: command(self.robot, &self.commands, row), q, dq };
            std::iter::repeat_n(step, self.clock.periods_between(t, row - from))
        };
        (from..first).flat_map(of_row).collect()
    }

    /// Returns the smoothed measured state in `row` of a contiguous range.
    fn start(&self, range: &Range<usize>, row: usize, base: BaseMount) -> InitialState {
        let mut start =
            InitialState::standing_on(&Ground::FLAT, self.robot, self.robot.control.default_pose_f32(), 0.0);
        if base.is_fixed() {
            start = InitialState::at_rest(HELD_HEIGHT, self.robot.control.default_pose_f32());
        }
        let smoothed = |cells: &[f64]| smoothed(&self.log.t()[range.clone()], &cells[range.clone()], row - range.start);
        for joint in &self.commands {
            let (index, name) = (joint.joint.index(), joint.joint.name());
            let [q, derivative] = smoothed(self.log.q(name).expect("every joint of a log has its position"));
            start.q[index] = q as f32;
            let dq = self.log.dq(name).map(|dq| smoothed(dq)[0]).filter(|dq| dq.is_finite());
            start.dq[index] = dq.unwrap_or(derivative) as f32;
        }
        if !base.is_fixed() {
            let vector = |kind: &str| {
                ["x", "y", "z"].map(|axis| {
                    let cells = self.log.channel(&format!("{kind}_{axis}"));
                    cells.map(|cells| smoothed(cells)[0]).filter(|cell| cell.is_finite()).unwrap_or(0.0) as f32
                })
            };
            // Orientations within 20 ms are close, so the components are smoothed separately.
            let parts = ["w", "x", "y", "z"]
                .map(|part| self.log.channel(&format!("quat_{part}")).map_or(f64::NAN, |cells| smoothed(cells)[0]));
            let DQuat { x, y, z, w } = normalized(parts);
            start.base_orientation = [w, x, y, z].map(|part| part as f32);
            start.base_position = vector("pos");
            start.base_linear_velocity = vector("vel");
            if let Some(estimate) = &self.estimate {
                if self.log.channel("pos_z").is_none() {
                    start.base_position = estimate.position[row].as_vec3().to_array();
                }
                if self.log.channel("vel_x").is_none() {
                    start.base_linear_velocity = estimate.velocity[row].as_vec3().to_array();
                }
            }
            start.base_angular_velocity = vector("gyro");
        }
        start
    }
}

/// Returns value and derivative at `row` of a parabola fit through the cells within 20 ms.
///
/// Smoothing reduces the error of the initial state, which persists in the simulation. NaN if the cell itself is
/// missing.
fn smoothed(t: &[f64], cells: &[f64], row: usize) -> [f64; 2] {
    let near = (0..cells.len()).filter(|other| (t[*other] - t[row]).abs() < 0.0201 && cells[*other].is_finite());
    let near: Vec<_> = near.map(|other| (t[other] - t[row], cells[other])).collect();
    if !cells[row].is_finite() {
        return [f64::NAN; 2];
    }
    // A line for two cells, a constant for one.
    let order = near.len().min(3);
    let power = |t: f64, column: usize| t.powi(column as i32);
    let design = DMatrix::from_fn(near.len(), order, |row, column| power(near[row].0 / 0.02, column));
    let values = DVector::from_iterator(near.len(), near.iter().map(|(_, value)| *value));
    let solved = (design.transpose() * &design).cholesky().map(|factor| factor.solve(&(design.transpose() * values)));
    solved.map_or([cells[row], 0.0], |fit| [fit[0], fit.get(1).map_or(0.0, |derivative| derivative / 0.02)])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::go2;

    use super::*;

    const RATE_HZ: f64 = 200.0;

    /// Returns a log of one joint, whose position is `q` at a time [s].
    fn log(rows: usize, base: BaseMount, q: impl Fn(f64) -> f64) -> Log {
        let segments = vec![Segment { name: "all".to_owned(), base }];
        let column = |name: &str, of: &dyn Fn(f64) -> f64| {
            (name.to_owned(), (0..rows).map(|row| of(row as f64 / RATE_HZ)).collect::<Vec<_>>())
        };
        let columns = [
            column("t", &|t| t),
            column("q_FL_hip", &q),
            column("q_cmd_FL_hip", &|t| t),
            column("kp", &|_| 25.0),
            column("kd", &|_| 0.6),
        ];
        Log::new(Meta::new(RATE_HZ, TorqueSensor::None, segments), columns).expect("a log")
    }

    proptest! {
        #[test]
        fn windows_cover_every_row_and_overlap_in_one(rows in 3usize..1500, length_s in 0.05f64..3.0) {
            let horizon = WindowConfig { fixed_length_s: length_s, ..WindowConfig::DIAGNOSIS };
            let windows = windows(&log(rows, BaseMount::Fixed, |t| t), &go2(), horizon).expect("a fixed base");
            prop_assert_eq!(windows[0].rows.start, 0);
            prop_assert_eq!(windows[windows.len() - 1].rows.end, rows);
            for pair in windows.windows(2) {
                prop_assert_eq!(pair[0].rows.end, pair[1].rows.start + 1);
            }
            for window in &windows {
                // One actuator period per row at 200 Hz.
                prop_assert_eq!(window.commands.len(), window.rows.len() - 1);
                prop_assert!(window.history.len() <= (HISTORY_S * RATE_HZ) as usize);
                prop_assert_eq!(window.history.is_empty(), window.rows.start == 0);
            }
        }

        #[test]
        fn initial_state_of_a_parabola_is_exact(a in -1.0f64..1.0, b in -5.0f64..5.0, c in -20.0f64..20.0) {
            let motion = |t: f64| a + b * t + 0.5 * c * t * t;
            let horizon = WindowConfig { fixed_length_s: 0.1, ..WindowConfig::DIAGNOSIS };
            let windows = windows(&log(100, BaseMount::Fixed, motion), &go2(), horizon).expect("a fixed base");
            for window in &windows {
                let t = window.rows.start as f64 / RATE_HZ;
                prop_assert!((f64::from(window.start.q[0]) - motion(t)).abs() < 1e-5);
                prop_assert!((f64::from(window.start.dq[0]) - (b + c * t)).abs() < 1e-4);
            }
        }
    }

    /// Returns a log of a floating robot with this kp and feed-forward torque [N·m] in each row.
    fn floating(kp: impl Fn(usize) -> f64, tau_ff: impl Fn(usize) -> f64) -> Log {
        let segments = vec![Segment { name: "all".to_owned(), base: BaseMount::Floating }];
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..100).map(of).collect::<Vec<_>>());
        let mut columns = vec![column("t", &|row| row as f64 / RATE_HZ)];
        for joint in Joint::ALL {
            columns.push(column(&format!("q_{joint}"), &|_| 0.0));
            columns.push(column(&format!("q_cmd_{joint}"), &|_| 0.0));
        }
        for name in ["quat_x", "quat_y", "quat_z", "pos_x", "pos_y", "pos_z", "vel_x", "vel_y", "vel_z"] {
            columns.push(column(name, &|_| 0.0));
        }
        columns.push(column("quat_w", &|_| 1.0));
        columns.push(column("kp", &kp));
        columns.push(column("kd", &|_| 3.0));
        columns.push(column("tau_ff_FL_hip", &tau_ff));
        Log::new(Meta::new(RATE_HZ, TorqueSensor::None, segments), columns).expect("a log")
    }

    #[test]
    fn robot_on_the_ground_is_not_simulated_while_its_motors_only_brake() {
        let log =
            floating(|row| if (40..70).contains(&row) { 0.0 } else { 30.0 }, |row| if row >= 60 { 1.0 } else { 0.0 });
        let windows = windows(&log, &go2(), WindowConfig::EVALUATION).expect("a measured base");
        let rows: Vec<_> = windows.iter().map(|window| window.rows.clone()).collect();
        assert_eq!(rows, [0..40, 60..100]);
    }

    #[test]
    fn log_without_a_row_to_simulate_is_refused() {
        let error = windows(&floating(|_| 0.0, |_| 0.0), &go2(), WindowConfig::EVALUATION).expect_err("refused");
        assert!(error.to_string().starts_with("none of the 100 rows"), "{error}");
    }

    #[test]
    fn floating_base_without_its_motion_is_refused_by_name() {
        let error =
            windows(&log(50, BaseMount::Floating, |t| t), &go2(), WindowConfig::EVALUATION).expect_err("refused");
        assert!(error.to_string().contains("the log has no `quat_w`"), "{error}");
    }

    #[test]
    fn history_has_the_commands_before_the_window_oldest_first() {
        let horizon = WindowConfig { fixed_length_s: 0.1, ..WindowConfig::DIAGNOSIS };
        let windows = windows(&log(100, BaseMount::Fixed, |t| t), &go2(), horizon).expect("a fixed base");
        let window = &windows[2];
        let commanded: Vec<f32> = window.history.iter().map(|step| step.command.q[0]).collect();
        let expected: Vec<f32> =
            (0..8).map(|age| (window.rows.start as f64 / RATE_HZ - 0.005 * f64::from(8 - age)) as f32).collect();
        assert!(commanded.iter().zip(&expected).all(|(one, other)| (one - other).abs() < 1e-6), "{commanded:?}");
        assert_eq!(commanded.len(), 8);
    }
}
