//! Interface between identification and simulators: simulates command sequences with many candidate robots at once.

use crate::{Actuator, BaseMount, Command, InitialState, PerJoint, RobotModel, RobotStates};

/// Simulation of one candidate robot.
#[derive(Clone, Copy, Debug)]
pub struct RolloutRequest<'a> {
    /// The candidate robot.
    pub robot: &'a RobotModel,
    /// Base mount of the candidate.
    pub base: BaseMount,
    /// Initial state.
    pub start: InitialState,
    /// Actuator periods before the start, oldest first; they initialise the actuator state. Before them the robot was
    /// at rest.
    pub history: &'a [HistoryStep],
    /// Commands, one per actuator period.
    pub commands: &'a [Command],
    /// Factors on the torque for supply voltage and motor temperature, one entry per actuator period; empty for 1.
    pub derating: &'a [PerJoint],
}

/// Command and measured state of one past actuator period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HistoryStep {
    /// Command of the period.
    pub command: Command,
    /// Encoder readings of the joint positions at its start [rad].
    pub q: PerJoint,
    /// Joint velocities at its start [rad/s].
    pub dq: PerJoint,
}

/// Floating-point precision of a simulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Single precision: several times as fast, for a global search.
    Single,
    /// Double precision: for derivatives by finite differences.
    Double,
}

/// Simulates candidate robots.
pub trait Rollout {
    /// Simulates every request and returns its states.
    ///
    /// Each array has one entry for the initial state and one after each actuator period. If a simulation diverges, its
    /// values are not finite from then on.
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates>;

    /// Returns the external actuator of one robot with the rates of `robot`, or `None` if the actuators are analytic.
    fn actuator(&self, robot: &RobotModel) -> Option<Box<dyn Actuator>> {
        let _ = robot;
        None
    }
}
