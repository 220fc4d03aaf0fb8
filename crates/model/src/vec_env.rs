//! Interface of a batch of environments that are reset and stepped together.

use serde::{Deserialize, Serialize};

use crate::{BackendError, EnvSpec, GaitCommand, RealTimeReport, RobotSample, Scene, VelocityCommand};

/// Batch of environments of one task, in this process or on a server.
///
/// Arrays are row-major: `num_envs × obs_len` observations, `num_envs × action_len` actions.
pub trait VecEnv: Send {
    /// Returns layouts, periods, gains and limits.
    fn spec(&self) -> &EnvSpec;

    /// Returns the number of environments.
    fn num_envs(&self) -> usize;

    /// Returns when an environment is reset after the end of its episode.
    fn autoreset(&self) -> AutoresetMode;

    /// Resets the selected environments and returns the observations of all environments, group `policy`.
    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError>;

    /// Returns the observations of group `policy` after the last reset or step, `num_envs × obs_len`.
    fn obs(&self) -> &[f32];

    /// Returns the observations of group `critic` after the last reset or step, `num_envs × critic_obs_len`.
    ///
    /// Empty if the spec has no such group.
    fn critic_obs(&self) -> &[f32] {
        &[]
    }

    /// Returns the mean level of the robots on a course of patches; the first is 0. `None` without such a course.
    fn mean_level(&self) -> Option<f64> {
        None
    }

    /// Replaces the velocity commands of the task: forward [m/s], left [m/s], yaw rate [rad/s], one per environment.
    ///
    /// They are in force from the next step on, also in later episodes, until they are set again. A step that is rejected
    /// discards those that were set since the last step. Fails if the task has no velocity command, or if one is not
    /// finite or outside the bounds of `velocity_command` in the spec.
    fn set_velocity_commands(&mut self, _commands: &[VelocityCommand]) -> Result<(), EnvError> {
        Err(EnvError::NoVelocityCommand { task: self.spec().task.clone() })
    }

    /// Replaces the gait commands of the task: step frequency [Hz], phases of FR, RL and RR relative to FL [cycles], one
    /// per environment.
    ///
    /// They are in force as velocity commands are. Fails if the task has no gait command, or if one is not finite or
    /// outside the bounds of `step_frequency` and `phase_offset` in the spec.
    fn set_gait_commands(&mut self, _commands: &[GaitCommand]) -> Result<(), EnvError> {
        Err(EnvError::NoGaitCommand { task: self.spec().task.clone() })
    }

    /// Sets the policy period for which the actions of the next step are. Default: that of the last observation.
    ///
    /// Only a robot in real time has such periods; a simulation ignores it.
    fn set_action_tick(&mut self, _tick: u64) {}

    /// Returns the report of the robot after the last reset or step. `None` in a simulation.
    fn real_time(&self) -> Option<&RealTimeReport> {
        None
    }

    /// Advances every environment by one policy period.
    ///
    /// `actions` are offsets from the default pose in units of `action_scale`, clipped to [−1, 1]. Fails if one is NaN
    /// or infinite.
    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError>;

    /// Adds `velocity` to the linear velocity of the robot of environment `env`, in the world frame [m/s].
    ///
    /// Fails if the robot is not simulated in this process.
    fn push(&mut self, env: usize, _velocity: [f32; 3]) -> Result<(), EnvError> {
        Err(BackendError::CannotPush { robot: env, reason: "it is not simulated in this process" }.into())
    }

    /// Returns the current scene of environment `env` for rendering.
    fn scene(&self, _env: usize) -> Result<Scene, EnvError> {
        Err(EnvError::RenderUnsupported { task: self.spec().task.clone() })
    }

    /// Returns the samples of environment `env` in the last step, one per actuator period.
    ///
    /// Sampling begins with the first call, which returns no sample. A reset removes the samples.
    fn samples(&mut self, _env: usize) -> Result<Vec<RobotSample>, EnvError> {
        Err(EnvError::SamplesUnsupported { task: self.spec().task.clone() })
    }
}

/// When an environment is reset after the end of its episode, as in Gymnasium.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum AutoresetMode {
    /// In the step after the last one of the episode. The action of that step is ignored and its reward is 0.
    NextStep,
    /// In the last step of the episode. [`EndedEpisode::final_obs`] has the episode's last observation.
    SameStep,
    /// Never; the client resets it.
    Disabled,
}

/// Environments to reset, and their seeds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ResetRequest {
    /// One seed per environment. Default: each environment continues its random stream.
    pub seeds: Option<Vec<u64>>,
    /// True for each environment to reset. Default: all.
    pub mask: Option<Vec<bool>>,
}

impl ResetRequest {
    /// Returns a request to reset all environments. Environment `i` has seed `seed + i`, as in Gymnasium.
    pub fn seeded(seed: u64, num_envs: usize) -> Self {
        Self { seeds: Some((0..num_envs as u64).map(|env| seed.wrapping_add(env)).collect()), mask: None }
    }

    /// Returns a request to reset the environments that are true in `mask`.
    pub fn masked(mask: Vec<bool>) -> Self {
        Self { seeds: None, mask: Some(mask) }
    }

    /// Fails if the length of `seeds` or `mask` is not `num_envs`.
    pub fn check(&self, num_envs: usize) -> Result<(), EnvError> {
        let lengths = [("seeds", self.seeds.as_ref().map(Vec::len)), ("mask", self.mask.as_ref().map(Vec::len))];
        for (field, length) in lengths {
            if let Some(given) = length.filter(|given| *given != num_envs) {
                return Err(EnvError::WrongLength { field, given, expected: num_envs });
            }
        }
        Ok(())
    }

    /// Returns true if the request resets environment `env`.
    pub fn selects(&self, env: usize) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask[env])
    }
}

/// Result of one step of all environments.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepBatch {
    /// Observations of group `policy`, `num_envs × obs_len`.
    pub obs: Vec<f32>,
    /// Observations of group `critic`, `num_envs × critic_obs_len`.
    pub critic_obs: Vec<f32>,
    /// Rewards, one per environment.
    pub reward: Vec<f32>,
    /// True if the task ended the episode, per environment.
    pub terminated: Vec<bool>,
    /// True if the time limit or a diverged simulation ended the episode, per environment.
    pub truncated: Vec<bool>,
    /// Episodes that ended in this step.
    pub ended: Vec<EndedEpisode>,
    /// Report of a robot in real time. `None` in a simulation.
    pub real_time: Option<RealTimeReport>,
}

impl StepBatch {
    /// Returns a batch of zeros for `num_envs` environments.
    pub fn new(num_envs: usize, spec: &EnvSpec) -> Self {
        Self {
            obs: vec![0.0; num_envs * spec.obs_len()],
            critic_obs: vec![0.0; num_envs * spec.critic_obs_len()],
            reward: vec![0.0; num_envs],
            terminated: vec![false; num_envs],
            truncated: vec![false; num_envs],
            ended: Vec::new(),
            real_time: None,
        }
    }

    /// Returns true if the episode of environment `env` ended in this step.
    pub fn done(&self, env: usize) -> bool {
        self.terminated[env] || self.truncated[env]
    }
}

/// An episode that ended in a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EndedEpisode {
    /// The environment.
    pub env: usize,
    /// Length of the episode [policy steps].
    pub length: u32,
    /// Undiscounted sum of the episode's rewards.
    pub episode_return: f32,
    /// Sum of each weighted reward term, in the order of [`EnvSpec::reward_terms`].
    pub terms: Vec<f32>,
    /// True if the simulation of the robot became NaN or infinite in this step. The episode is truncated, and its last
    /// observation is that before the step.
    pub diverged: bool,
    /// Last observation of the episode with [`AutoresetMode::SameStep`]. Empty in the other modes: `obs` contains it.
    pub final_obs: Vec<f32>,
    /// The same of group `critic`.
    pub final_critic_obs: Vec<f32>,
}

/// Error of a batch of environments.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// An array has the wrong number of entries.
    #[error("`{field}` has {given} entries; {expected} are expected")]
    WrongLength {
        /// The array.
        field: &'static str,
        /// Number of entries of the array.
        given: usize,
        /// Expected number of entries.
        expected: usize,
    },
    /// An action is NaN or infinite. No environment was stepped.
    #[error("`actions` of environment {env}: {entry} is {value}, but must be finite; no environment was stepped")]
    ActionNotFinite {
        /// The environment.
        env: usize,
        /// Name of the entry, such as `joint_position_offset[FL_hip]`.
        entry: String,
        /// Value of the entry.
        value: f32,
    },
    /// The environment was never reset, or not after the end of its episode. No environment was stepped.
    #[error("environment {env} has no episode: reset it first; no environment was stepped")]
    NeedsReset {
        /// The environment.
        env: usize,
    },
    /// The task has no velocity command. No environment was stepped.
    #[error("the task `{task}` has no velocity command")]
    NoVelocityCommand {
        /// The task.
        task: String,
    },
    /// The task has no gait command.
    #[error("the task `{task}` has no gait command")]
    NoGaitCommand {
        /// The task.
        task: String,
    },
    /// A command is not finite, or outside its bounds. No environment was stepped.
    #[error(
        "`{field}` of environment {env}: {entry} is {value}; {low} to {high} is allowed; no environment was stepped"
    )]
    CommandOutOfRange {
        /// The field of the step request: `command` or `gait_command`.
        field: &'static str,
        /// The environment.
        env: usize,
        /// Name of the entry, such as `velocity_command[0]`.
        entry: String,
        /// Value of the entry.
        value: f32,
        /// Lowest allowed value.
        low: f32,
        /// Highest allowed value.
        high: f32,
    },
    /// There is no such environment.
    #[error("`env` = {env} does not exist; the number of environments is {num_envs}")]
    EnvOutOfRange {
        /// Requested environment.
        env: usize,
        /// Number of environments.
        num_envs: usize,
    },
    /// The task has no robot to render.
    #[error("the task `{task}` cannot be rendered")]
    RenderUnsupported {
        /// The task.
        task: String,
    },
    /// The environment has no samples of its actuator periods.
    #[error("the environment of task `{task}` has no samples of its actuator periods")]
    SamplesUnsupported {
        /// The task.
        task: String,
    },
    /// The backend failed.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The server or the connection to it failed.
    #[error(transparent)]
    Remote(Box<dyn std::error::Error + Send + Sync>),
}
