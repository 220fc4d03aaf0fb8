//! The commands of a log, row by row, and its time in periods of the actuator: what a replay and a play have in common.

use twinstep_logs::Log;
use twinstep_model::{BackendError, Command, JOINT_NAMES, Joint, RobotModel};

/// How far a log's period may be from a whole number of actuator periods, as a fraction of it.
const PERIOD_TOLERANCE: f64 = 0.02;

/// Why the commands of a log cannot be given to a robot.
#[derive(Debug, thiserror::Error)]
pub enum MotionError {
    /// The robot model has no joint of this name.
    #[error(
        "joint `{joint}` of the log is none of the robot's\n  its joints are {names}",
        names = JOINT_NAMES.join(", ")
    )]
    UnknownJoint {
        /// The joint's name.
        joint: String,
    },
    /// The log lacks a column that its joints need.
    #[error("joint `{joint}` of the log has no `{quantity}`")]
    Missing {
        /// The joint's name.
        joint: String,
        /// The quantity that is missing.
        quantity: &'static str,
    },
    /// No part of the log has two rows.
    #[error("the log has no two rows that follow one another in a segment, so there is nothing to simulate")]
    NoSteps,
    /// The actuator's rate does not fit the log's.
    #[error(
        "the log's median sample period is {period_ms:.3} ms, not a whole number of the actuator's {actuator_ms:.3} ms \
         within 2 %\n  resample the log, or give the robot model a `actuator_hz` that the log's rate divides"
    )]
    Period {
        /// Median time between two rows [ms].
        period_ms: f64,
        /// One period of the actuator [ms].
        actuator_ms: f64,
    },
}

/// A simulation that failed, and where in the log.
#[derive(Debug, thiserror::Error)]
#[error("segment `{segment}`, row {row} (t = {t} s): {cause}")]
pub struct SimulationFailure {
    /// The segment's name.
    pub segment: String,
    /// The data row from which was stepped, from 1.
    pub row: usize,
    /// Its time [s].
    pub t: f64,
    /// What the simulation said.
    pub cause: BackendError,
}

/// What a log tells one joint, in each of its rows.
pub struct JointCommands<'a> {
    /// The joint.
    pub joint: Joint,
    /// Wanted position [rad].
    pub q_cmd: &'a [f64],
    /// Wanted velocity [rad/s].
    pub dq_cmd: Option<&'a [f64]>,
    /// Feed-forward torque [N·m].
    pub tau_ff: Option<&'a [f64]>,
    /// Position gain [N·m/rad]; none where the model's counts.
    pub kp: Option<Vec<f64>>,
    /// Velocity gain [N·m·s/rad]; none where the model's counts.
    pub kd: Option<Vec<f64>>,
}

impl<'a> JointCommands<'a> {
    fn of(log: &'a Log, name: &str) -> Result<Self, MotionError> {
        let gains =
            |gain: fn(&Log, &str, usize) -> Option<f64>| (0..log.rows()).map(|row| gain(log, name, row)).collect();
        let missing = || MotionError::Missing { joint: name.to_owned(), quantity: "q_cmd" };
        Ok(Self {
            joint: name.parse().map_err(|_| MotionError::UnknownJoint { joint: name.to_owned() })?,
            q_cmd: log.q_cmd(name).ok_or_else(missing)?,
            dq_cmd: log.dq_cmd(name),
            tau_ff: log.tau_ff(name),
            kp: gains(Log::kp),
            kd: gains(Log::kd),
        })
    }
}

/// What a log tells its joints, in the order of [`Joint::ALL`].
pub fn joint_commands(log: &Log) -> Result<Vec<JointCommands<'_>>, MotionError> {
    let mut joints: Vec<_> = log.joints().iter().map(|name| JointCommands::of(log, name)).collect::<Result<_, _>>()?;
    joints.sort_by_key(|joint| joint.joint);
    Ok(joints)
}

/// The command of a row, in force to the next.
///
/// Joints that the log lacks hold the default pose; a missing velocity or feed-forward torque is zero.
pub fn command(robot: &RobotModel, joints: &[JointCommands], row: usize) -> Command {
    let control = &robot.control;
    let mut command = Command::hold(control.default_pose_f32(), control.kp as f32, control.kd as f32);
    for joint in joints {
        let index = joint.joint.index();
        command.q[index] = joint.q_cmd[row] as f32;
        command.dq[index] = cell_or_zero(joint.dq_cmd, row);
        command.tau_ff[index] = cell_or_zero(joint.tau_ff, row);
        for (gain, given) in [(&mut command.kp[index], &joint.kp), (&mut command.kd[index], &joint.kd)] {
            if let Some(given) = given {
                *gain = given[row] as f32;
            }
        }
    }
    command
}

/// A cell of a column that may be missing, and be missing in it.
pub fn cell_or_zero(column: Option<&[f64]>, row: usize) -> f32 {
    column.map(|cells| cells[row]).filter(|cell| cell.is_finite()).unwrap_or(0.0) as f32
}

/// How a log's time counts in periods of the actuator.
pub struct ActuatorClock {
    /// One period of the actuator on the log's clock [s].
    period: f64,
}

impl ActuatorClock {
    /// The clock of `log` for the actuators of `robot`.
    pub fn of(log: &Log, robot: &RobotModel) -> Result<Self, MotionError> {
        let mut steps: Vec<f64> =
            log.segments().flat_map(|(_, rows)| log.t()[rows].windows(2).map(|pair| pair[1] - pair[0])).collect();
        steps.sort_by(f64::total_cmp);
        let median = *steps.get(steps.len() / 2).ok_or(MotionError::NoSteps)?;
        let actuator_dt = robot.control.actuator_dt();
        let periods = (median / actuator_dt).round();
        if periods < 1.0 || (median / (periods * actuator_dt) - 1.0).abs() > PERIOD_TOLERANCE {
            return Err(MotionError::Period { period_ms: median * 1e3, actuator_ms: actuator_dt * 1e3 });
        }
        Ok(Self { period: median / periods })
    }

    /// Actuator periods from `row` to the next, of a part that begins at `t[0]`.
    ///
    /// Both ends are counted from the part's start, so that jitter does not add up and a gap has its length.
    pub fn periods_between(&self, t: &[f64], row: usize) -> usize {
        let periods_to = |row: usize| ((t[row] - t[0]) / self.period).round() as usize;
        periods_to(row + 1) - periods_to(row)
    }
}
