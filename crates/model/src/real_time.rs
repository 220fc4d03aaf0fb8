//! What a robot in real time reports besides its sensor readings.

use crate::PerJoint;

/// Report of a robot in real time after a reset or a step.
#[derive(Clone, Debug, PartialEq)]
pub struct RealTimeReport {
    /// Number of the policy period that begins with the observation. The next action is for this period.
    pub tick: u64,
    /// Time of the sensor readings since the start of the robot's clock [ns].
    pub stamp_ns: u64,
    /// Number of policy periods in a row that ended without an action.
    pub late_ticks: u64,
    /// Action in force after clipping and limiting, in units of the action scale. The next observation contains it.
    pub applied: PerJoint,
    /// Reason why the action of the step was not executed. `None`: it was executed, or there was none.
    pub refused: Option<String>,
    /// Why the robot follows no actions. `None` while it follows them.
    pub stop: Option<RobotStop>,
}

/// Why a robot follows no actions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RobotStop {
    /// The reason, for people.
    pub reason: String,
    /// True if the robot's own motion is the reason, such as a fall: the episode terminates. False if it is truncated.
    pub terminates: bool,
}

/// Why a backend is about to reset a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetCause {
    /// An agent has asked for it.
    Request,
    /// An episode has ended and the environments start the next one by themselves. It never moves a real robot.
    Autoreset,
}
