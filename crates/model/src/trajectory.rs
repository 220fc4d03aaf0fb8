//! Steps of a batch of environments in a row.

use crate::{EndedEpisode, EnvSpec, StepBatch};

/// What a policy observed and did in consecutive steps of a batch of environments, and the rewards.
///
/// Arrays are row-major, `[step][environment][entry]`. Observations have one step more than the other arrays: the last
/// ones are those after the last step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Number of steps.
    pub steps: usize,
    /// Number of environments.
    pub num_envs: usize,
    /// Observations of group `policy`, `steps + 1 × num_envs × obs_len`.
    pub obs: Vec<f32>,
    /// Observations of group `critic`, `steps + 1 × num_envs × critic_obs_len`.
    pub critic_obs: Vec<f32>,
    /// Sampled actions, not clipped, `steps × num_envs × action_len`.
    pub actions: Vec<f32>,
    /// Logarithm of the probability density of each action [nat], `steps × num_envs`.
    pub log_prob: Vec<f32>,
    /// Rewards, `steps × num_envs`.
    pub reward: Vec<f32>,
    /// True if the task ended the episode, `steps × num_envs`.
    pub terminated: Vec<bool>,
    /// True if the time limit or a diverged simulation ended the episode, `steps × num_envs`.
    pub truncated: Vec<bool>,
    /// Episodes that ended, with the step in which they did, in this order.
    pub ended: Vec<(usize, EndedEpisode)>,
}

impl Trajectory {
    /// Starts a trajectory of at most `max_steps` steps with the observations `obs` and `critic_obs`.
    pub fn start(&mut self, max_steps: usize, spec: &EnvSpec, obs: &[f32], critic_obs: &[f32]) {
        let num_envs = obs.len() / spec.obs_len();
        (self.steps, self.num_envs) = (0, num_envs);
        for (array, len) in [
            (&mut self.obs, obs.len() * (max_steps + 1)),
            (&mut self.critic_obs, critic_obs.len() * (max_steps + 1)),
            (&mut self.actions, num_envs * spec.action_len() * max_steps),
            (&mut self.log_prob, num_envs * max_steps),
            (&mut self.reward, num_envs * max_steps),
        ] {
            array.resize(len, 0.0);
        }
        self.terminated.resize(num_envs * max_steps, false);
        self.truncated.resize(num_envs * max_steps, false);
        self.ended.clear();
        self.obs[..obs.len()].copy_from_slice(obs);
        self.critic_obs[..critic_obs.len()].copy_from_slice(critic_obs);
    }

    /// Appends the result of a step, except its actions.
    ///
    /// Panics if there are more steps than the trajectory was started for.
    pub fn push(&mut self, batch: &StepBatch) {
        let (step, rows) = (self.steps, self.steps * self.num_envs..(self.steps + 1) * self.num_envs);
        let (obs, critic_obs) = (batch.obs.len(), batch.critic_obs.len());
        self.obs[(step + 1) * obs..][..obs].copy_from_slice(&batch.obs);
        self.critic_obs[(step + 1) * critic_obs..][..critic_obs].copy_from_slice(&batch.critic_obs);
        self.reward[rows.clone()].copy_from_slice(&batch.reward);
        self.terminated[rows.clone()].copy_from_slice(&batch.terminated);
        self.truncated[rows].copy_from_slice(&batch.truncated);
        self.ended.extend(batch.ended.iter().map(|episode| (step, episode.clone())));
        self.steps += 1;
    }

    /// Returns true if the episode of environment `env` ended in step `step`.
    pub fn done(&self, step: usize, env: usize) -> bool {
        let index = step * self.num_envs + env;
        self.terminated[index] || self.truncated[index]
    }
}
