//! Interface of a task: observations, reward terms and the end of an episode.

use glam::Quat;
use twinstep_model::{EnvSpec, GaitCommand, Ground, GroundTruth, Measured, Stream, VelocityCommand};

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
    fn start(&self, random: &mut Stream) -> (Vec<f32>, Self::State);

    /// Returns the rotation of the base at the start, relative to a robot that stands on the ground.
    fn start_rotation(&self, _state: &Self::State) -> Quat {
        Quat::IDENTITY
    }

    /// Completes the state of an episode whose robot is in place.
    fn place(&self, _state: &mut Self::State, _robot: &RobotView) {}

    /// Returns how many frames the observation has: the present one, and earlier ones, which [`crate::TaskEnv`] keeps.
    fn frames(&self) -> usize {
        1
    }

    /// Writes the present frame of the observation of group `policy`. `action` is the last action, clipped to [−1, 1]; 0 after a reset.
    fn observe(&self, state: &Self::State, robot: &RobotView, action: &[f32], obs: &mut [f32]);

    /// Writes the observation of group `critic`. Called only if the spec has one.
    fn observe_critic(&self, _state: &Self::State, _robot: &RobotView, _obs: &mut [f32]) {}

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

/// Writes the observation of group `policy`: its frames move back by one, and the present one comes first.
pub fn observe_next<T: Task>(task: &T, state: &T::State, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
    let frame = obs.len() / task.frames();
    obs.copy_within(..obs.len() - frame, frame);
    task.observe(state, robot, action, &mut obs[..frame]);
}

/// Makes all frames of an observation like the present one: a new episode has no earlier ones.
pub fn repeat_first_frame(task: &impl Task, obs: &mut [f32]) {
    let (first, earlier) = obs.split_at_mut(obs.len() / task.frames());
    earlier.chunks_exact_mut(first.len()).for_each(|frame| frame.copy_from_slice(first));
}

/// One robot after a reset or a step.
#[derive(Clone, Copy, Debug)]
pub struct RobotView<'a> {
    /// Joint positions [rad or m].
    pub q: &'a [f32],
    /// Joint velocities [rad/s or m/s].
    pub dq: &'a [f32],
    /// Torques estimated from the motor currents, means over the last actuator period [N·m or N].
    pub tau: &'a [f32],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Angular velocity of the base, read by the gyroscope in the base frame [rad/s].
    pub gyro: [f32; 3],
    /// What only a simulator knows; `None` on a real robot.
    pub truth: Option<Truth<'a>>,
    /// The ground under the robot.
    pub ground: &'a Ground,
}

/// What only a simulator knows of one robot.
#[derive(Clone, Copy, Debug)]
pub struct Truth<'a> {
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: [f32; 3],
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: [f32; 3],
    /// Angular velocity of the base, in the base frame, without the bias of the gyroscope [rad/s].
    pub base_angular_velocity: [f32; 3],
    /// Normal force on each foot [N].
    pub foot_force: &'a [f32],
    /// True if a link other than those that may touches the ground.
    pub body_contact: bool,
    /// Epistemic uncertainty of the actuators, mean over the joints [nat]; 0 if they do not estimate it.
    pub epistemic_uncertainty: f32,
}

impl<'a> RobotView<'a> {
    /// Returns robot `index` of a batch.
    pub fn of(measured: &'a Measured, truth: Option<&'a GroundTruth>, ground: &'a Ground, index: usize) -> Self {
        Self {
            q: &measured.q[index],
            dq: &measured.dq[index],
            tau: &measured.tau[index],
            orientation: measured.orientation[index],
            gyro: measured.gyro[index],
            truth: truth.map(|truth| Truth {
                base_position: truth.base_position[index],
                base_linear_velocity: truth.base_linear_velocity[index],
                base_angular_velocity: truth.base_angular_velocity[index],
                foot_force: &truth.foot_force[index],
                body_contact: truth.body_contact[index],
                epistemic_uncertainty: truth.epistemic_uncertainty[index],
            }),
            ground,
        }
    }
}

/// One robot after a policy step, with what it was before.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// The robot after the step.
    pub robot: RobotView<'a>,
    /// Action of the step, clipped to [−1, 1].
    pub action: &'a [f32],
    /// Action of the previous step, clipped to [−1, 1].
    pub previous_action: &'a [f32],
    /// Joint velocity before the step [rad/s].
    pub previous_dq: &'a [f32],
    /// Number of policy steps of the episode, including this one.
    pub length: u32,
}
