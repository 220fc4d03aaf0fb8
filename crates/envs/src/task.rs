//! Interface of a task: observations, reward terms and the end of an episode.

use twinstep_model::{EnvSpec, GaitCommand, Ground, GroundTruth, Measured, PerJoint, Stream, VelocityCommand};

/// A task on one robot. [`crate::TaskEnv`] runs it on many.
///
/// Observations of group `policy` depend on sensor readings only, so that they are the same on a real robot. Group
/// `critic` is privileged: it depends on the ground truth of a simulator, and only a critic reads it.
pub trait Task: Send {
    /// What the task stores for the current episode of one environment.
    type State: Default + Send;

    /// Returns the layouts of both groups, the names of the reward terms, periods, gains and limits.
    fn spec(&self) -> &EnvSpec;

    /// Starts an episode. Returns the initial joint positions [rad] and the state.
    fn start(&self, random: &mut Stream) -> (PerJoint, Self::State);

    /// Writes the observation of group `policy`. `action` is the last action, clipped to [−1, 1]; 0 after a reset.
    fn observe(&self, state: &Self::State, robot: &RobotView, action: &PerJoint, obs: &mut [f32]);

    /// Writes the observation of group `critic`. Called only if the spec has one.
    fn observe_critic(&self, state: &Self::State, robot: &RobotView, obs: &mut [f32]);

    /// Writes the weighted reward terms of a policy step into `terms`, and advances the state.
    ///
    /// Returns true if the episode terminates.
    fn evaluate(&self, state: &mut Self::State, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool;

    /// Returns the velocity command for rendering: forward [m/s], left [m/s], yaw rate [rad/s].
    fn velocity_command(&self, _state: &Self::State) -> Option<[f32; 3]> {
        None
    }

    /// Sets the velocity command for the rest of the episode. A task with `velocity_command` in its observation has one.
    fn set_velocity_command(&self, _state: &mut Self::State, _command: VelocityCommand) {}

    /// Sets the gait command for the rest of the episode. A task with `step_frequency` and `phase_offset` in its
    /// observation has one.
    fn set_gait_command(&self, _state: &mut Self::State, _command: GaitCommand) {}
}

/// One robot after a reset or a step.
#[derive(Clone, Copy, Debug)]
pub struct RobotView<'a> {
    /// Sensor readings of all robots.
    pub measured: &'a Measured,
    /// What only a simulator knows of all robots; `None` on a real robot.
    pub truth: Option<&'a GroundTruth>,
    /// The ground under the robots.
    pub ground: &'a Ground,
    /// Index of the robot.
    pub index: usize,
}

/// One robot after a policy step, with what it was before.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// The robot after the step.
    pub robot: RobotView<'a>,
    /// Action of the step, clipped to [−1, 1].
    pub action: &'a PerJoint,
    /// Action of the previous step, clipped to [−1, 1].
    pub previous_action: &'a PerJoint,
    /// Joint velocity before the step [rad/s].
    pub previous_dq: &'a PerJoint,
    /// Number of policy steps of the episode, including this one.
    pub length: u32,
}
