//! The seam between identification and simulators: commands in, motion out, for many candidate robots at once.

use crate::{Command, PerJoint, InitialState, RobotModel, RobotStates};

/// What one candidate robot does.
#[derive(Clone, Copy, Debug)]
pub struct RolloutRequest<'a> {
    /// The candidate.
    pub robot: &'a RobotModel,
    /// Whether its trunk is held.
    pub held: bool,
    /// Where it starts.
    pub start: InitialState,
    /// What it did just before, the oldest first: what its drives remember. Before that it held still.
    pub history: &'a [HistoryStep],
    /// One command a drive period.
    pub commands: &'a [Command],
}

/// A drive period that is over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HistoryStep {
    /// What was commanded.
    pub command: Command,
    /// Joint positions at its start, as the encoders show them [rad].
    pub q: PerJoint,
    /// Joint velocities [rad/s].
    pub dq: PerJoint,
}

/// The numbers that candidates are simulated in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Single: several times as fast, for comparing candidates that are far apart.
    Single,
    /// Double: for derivatives, which are small differences.
    Double,
}

/// Plays commands through candidate robots.
pub trait Rollout {
    /// The states of every job: one entry in each array at its start and one after each drive period. From where a job
    /// diverged its numbers are not finite.
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates>;
}
