//! The seam above an environment: a batch of environments that are reset and stepped together.

use serde::{Deserialize, Serialize};

use crate::{EnvSpec, Scene};

/// Many environments of one task, in this process or at the other end of a network.
///
/// Arrays are row-major: `num_envs × obs_len` observations, `num_envs × action_len` actions.
pub trait VecEnv: Send {
    /// Layouts, periods, gains and limits.
    fn spec(&self) -> &EnvSpec;

    /// Number of environments.
    fn num_envs(&self) -> usize;

    /// When an ended episode starts anew.
    fn autoreset(&self) -> AutoresetMode;

    /// Starts episodes anew and returns the observations of all environments.
    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError>;

    /// Advances every environment by one policy period.
    ///
    /// `actions` are offsets from the default pose in units of `action_scale`, clipped to [−1, 1]; NaN is refused.
    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError>;

    /// What it takes to draw environment `env` as it is now. Changes nothing.
    fn scene(&self, _env: usize) -> Result<Scene, EnvError> {
        Err(EnvError::RenderUnsupported { task: self.spec().task.clone() })
    }
}

/// When an ended episode starts anew, as in Gymnasium.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum AutoresetMode {
    /// In the step after the one that ended it; that step's action is ignored and its reward is 0.
    NextStep,
    /// In the step that ended it; the last observation of the episode is in [`EndedEpisode::final_obs`].
    SameStep,
    /// Not by itself: the client resets it.
    Disabled,
}

/// Which environments to reset, and with which seeds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ResetRequest {
    /// One seed an environment; without, each continues its own random stream.
    pub seeds: Option<Vec<u64>>,
    /// True where an environment is to be reset; without, all are.
    pub mask: Option<Vec<bool>>,
}

impl ResetRequest {
    /// Resets everything; environment `i` gets the seed `seed + i`, as Gymnasium's vector environments do.
    pub fn seeded(seed: u64, num_envs: usize) -> Self {
        Self { seeds: Some((0..num_envs as u64).map(|env| seed.wrapping_add(env)).collect()), mask: None }
    }

    /// Resets the environments that are true in `mask`.
    pub fn masked(mask: Vec<bool>) -> Self {
        Self { seeds: None, mask: Some(mask) }
    }

    /// Fails if an entry count is not `num_envs`.
    pub fn check(&self, num_envs: usize) -> Result<(), EnvError> {
        let lengths = [("seeds", self.seeds.as_ref().map(Vec::len)), ("mask", self.mask.as_ref().map(Vec::len))];
        for (field, length) in lengths {
            if let Some(given) = length.filter(|given| *given != num_envs) {
                return Err(EnvError::WrongLength { field, given, wanted: num_envs });
            }
        }
        Ok(())
    }

    /// True if environment `env` is to be reset.
    pub fn selects(&self, env: usize) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask[env])
    }
}

/// What one step of all environments gave.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepBatch {
    /// Observations, `num_envs × obs_len`.
    pub obs: Vec<f32>,
    /// Rewards, one an environment.
    pub reward: Vec<f32>,
    /// True where the task ended the episode.
    pub terminated: Vec<bool>,
    /// True where the time limit ended the episode.
    pub truncated: Vec<bool>,
    /// The episodes that ended in this step.
    pub ended: Vec<EndedEpisode>,
}

impl StepBatch {
    /// A batch of zeros for `num_envs` environments.
    pub fn new(num_envs: usize, obs_len: usize) -> Self {
        Self {
            obs: vec![0.0; num_envs * obs_len],
            reward: vec![0.0; num_envs],
            terminated: vec![false; num_envs],
            truncated: vec![false; num_envs],
            ended: Vec::new(),
        }
    }

    /// True where the episode of environment `env` ended in this step.
    pub fn done(&self, env: usize) -> bool {
        self.terminated[env] || self.truncated[env]
    }
}

/// An episode that ended in a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EndedEpisode {
    /// The environment.
    pub env: usize,
    /// Policy steps that the episode lasted.
    pub length: u32,
    /// Sum of its rewards.
    pub episode_return: f32,
    /// Sum of each weighted reward term, in the order of [`EnvSpec::reward_terms`].
    pub terms: Vec<f32>,
    /// Its last observation under [`AutoresetMode::SameStep`]; empty in the other modes, where `obs` has it.
    pub final_obs: Vec<f32>,
}

/// Why an environment did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// An array has the wrong number of entries.
    #[error("`{field}` has {given} entries; {wanted} are wanted")]
    WrongLength {
        /// The array.
        field: &'static str,
        /// How many entries it has.
        given: usize,
        /// How many it must have.
        wanted: usize,
    },
    /// An action is NaN or infinite; nothing was stepped.
    #[error("`actions` of environment {env}, {entry}, is {value}: actions must be finite; nothing was stepped")]
    ActionNotFinite {
        /// The environment.
        env: usize,
        /// The entry, such as `joint_position_offset[FL_hip]`.
        entry: String,
        /// The value.
        value: f32,
    },
    /// The environment was never reset, or its episode ended and nobody reset it; nothing was stepped.
    #[error("environment {env} has no episode: reset it first; nothing was stepped")]
    NeedsReset {
        /// The environment.
        env: usize,
    },
    /// There is no such environment.
    #[error("`env` = {env} does not exist; there are {num_envs}")]
    EnvOutOfRange {
        /// The environment that was asked for.
        env: usize,
        /// The number of environments.
        num_envs: usize,
    },
    /// The task has no robot that could be seen.
    #[error("the task `{task}` has nothing to draw")]
    RenderUnsupported {
        /// The task.
        task: String,
    },
    /// The simulation of an environment gave numbers that are not finite. The others were stepped.
    #[error("environment {env} diverged: `{quantity}` is not finite; reset it (`mask`) before the next step")]
    Diverged {
        /// The environment.
        env: usize,
        /// What is not finite.
        quantity: String,
    },
    /// The backend failed.
    #[error(transparent)]
    Backend(#[from] crate::BackendError),
    /// The other end of the network, or the way there, failed.
    #[error(transparent)]
    Remote(Box<dyn std::error::Error + Send + Sync>),
}
