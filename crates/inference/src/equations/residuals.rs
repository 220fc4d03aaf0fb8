//! Residuals of a log, linear around a robot.

use twinstep_model::RigidBody;

use super::block::{Block, Column};
use super::law::{Law, Place};
use super::robot::Robot;
use super::site::Site;

/// State of a joint.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Position [rad].
    pub q: f64,
    /// Velocity [rad/s].
    pub dq: f64,
    /// Torque of the drive [N·m].
    pub torque: f64,
}

/// Residuals of a log: measured minus what a robot would have, and what any change of the robot changes in them.
pub trait Residuals: Sync {
    /// What a robot has, from which residuals and columns are computed.
    type Predicted: Send + Sync;

    /// Returns true if the residuals are linear in small effects.
    fn is_linear(&self) -> bool;

    /// Returns the blocks, with any residuals.
    fn blocks(&self) -> &[Block];

    /// Returns what a robot has.
    fn predicted(&self, robot: &Robot) -> Self::Predicted;

    /// Returns the blocks with the residuals of a robot.
    fn residuals(&self, robot: &Robot, predicted: &Self::Predicted) -> Vec<Block>;

    /// Returns what a law changes at a site: the column of `after` minus `before`.
    fn column(&self, law: &Law, site: Site, before: (&Robot, &Self::Predicted), after: &Robot) -> Column;

    /// Returns the column of additional inertia of a body.
    fn inertia_column(&self, robot: &Robot, predicted: &Self::Predicted, body: usize, added: RigidBody) -> Column;

    /// Returns small unknowns of a joint that are no effects, with their standard deviations.
    fn small_at_joint(&self, predicted: &Self::Predicted, joint: usize) -> Vec<(Column, f64)>;

    /// Returns small unknowns of the motion and of its sensors that are no effects, with their standard deviations.
    fn small_of_motion(&self, robot: &Robot, predicted: &Self::Predicted) -> Vec<(Column, f64)>;

    /// Returns the equations that tell laws at a joint apart.
    fn places(&self) -> &[Place];

    /// Returns functions of what a joint measures, in the equations of a law's place, with what each depends on.
    fn functions(&self, predicted: &Self::Predicted, joint: usize, place: Place) -> Vec<(&'static str, Column)>;

    /// Returns the state of a joint at a time of the log [s].
    fn state(&self, predicted: &Self::Predicted, joint: usize, t: f64) -> State;
}
