//! Collection of transitions: a group of robots is stepped with the current policy.

use rand::Rng;
use twinstep_model::{EnvError, EnvSpec, ResetRequest, Stream, VecEnv, stream};
use twinstep_policy::{Activations, Mlp, Network, Normaliser, gaussian};

use crate::gae::{Discounts, Transitions, advantages};
use crate::statistics::Statistics;

/// Number of rows that are evaluated together, so that they stay in the processor's cache.
pub const BLOCK: usize = 64;

/// Actor, critic and normaliser while transitions are collected.
pub struct Behaviour<'a> {
    /// Network from the normalised observation of group `policy` to the mean action.
    pub actor: &'a Network,
    /// Network from the normalised observations of both groups to the value.
    pub critic: &'a Network,
    /// Logarithm of the standard deviation of each entry of the action.
    pub log_std: &'a [f32],
    /// Moments of the observations of both groups, `policy` first.
    pub normaliser: &'a Normaliser,
    /// Discounts of the advantage estimator.
    pub discounts: Discounts,
}

/// Transitions of a group of robots, row-major: `[step][robot]`.
///
/// A row of `features` has the normalised observation of group `policy`, then that of group `critic`.
#[derive(Clone, Debug, Default)]
pub struct Segment {
    /// Normalised observations before each step.
    pub features: Vec<f32>,
    /// Sampled actions, not clipped.
    pub actions: Vec<f32>,
    /// Log-probability of each action [nat].
    pub log_probs: Vec<f32>,
    /// Values of the states before the steps.
    pub values: Vec<f32>,
    /// Advantage of each step.
    pub advantages: Vec<f32>,
    rewards: Vec<f32>,
    done: Vec<bool>,
    /// Normalised last observation of each truncated episode, and the index of its transition.
    truncated: Vec<(usize, Vec<f32>)>,
}

/// Robots that are stepped together, and their transitions.
pub struct Group {
    env: Box<dyn VecEnv>,
    obs: Vec<f32>,
    critic_obs: Vec<f32>,
    random: Vec<Stream>,
    actor: Activations,
    critic: Activations,
    horizon: usize,
    /// Transitions of the last rollout.
    pub segment: Segment,
    /// Moments of the observations of the last rollout.
    pub moments: Normaliser,
    /// Rewards, falls and velocity errors of the last rollout.
    pub statistics: Statistics,
}

impl Group {
    /// Resets the robots of `env` with the seeds from `seed` on. `first_robot` is the index of its first robot.
    pub fn new(
        mut env: Box<dyn VecEnv>,
        networks: [&Mlp; 2],
        horizon: usize,
        seed: u64,
        first_robot: usize,
    ) -> Result<Self, EnvError> {
        let num_envs = env.num_envs();
        let robots = first_robot as u64..(first_robot + num_envs) as u64;
        let seeds = robots.clone().map(|robot| stream_seed(seed, robot)).collect();
        let obs = env.reset(&ResetRequest { seeds: Some(seeds), mask: None })?.to_vec();
        let feature_len = feature_len(env.spec());
        Ok(Self {
            obs,
            critic_obs: env.critic_obs().to_vec(),
            random: robots.map(|robot| stream(seed, "action", robot)).collect(),
            actor: Activations::new(networks[0], BLOCK),
            critic: Activations::new(networks[1], BLOCK),
            horizon,
            segment: Segment::default(),
            moments: Normaliser::identity(feature_len),
            statistics: Statistics::new(env.spec()),
            env,
        })
    }

    /// Returns the number of robots.
    pub fn num_envs(&self) -> usize {
        self.env.num_envs()
    }

    /// Steps the robots `horizon` times, and estimates the advantages.
    pub fn collect(&mut self, behaviour: &Behaviour) -> Result<(), EnvError> {
        let (num_envs, spec) = (self.env.num_envs(), self.env.spec().clone());
        let (action_len, feature_len) = (spec.action_len(), feature_len(&spec));
        let len = self.horizon * num_envs;
        let Segment { features, actions, log_probs, values, advantages, rewards, done, truncated } = &mut self.segment;
        features.resize(len * feature_len, 0.0);
        actions.resize(len * action_len, 0.0);
        for array in [&mut *log_probs, values, advantages, rewards] {
            array.resize(len, 0.0);
        }
        done.resize(len, false);
        truncated.clear();
        self.moments = Normaliser::identity(feature_len);
        self.statistics = Statistics::new(&spec);
        for step in 0..self.horizon {
            let range = step * num_envs..(step + 1) * num_envs;
            self.sample_actions(behaviour, &spec, range.clone());
            let Segment { actions, rewards, done, truncated, .. } = &mut self.segment;
            let batch = self.env.step(&actions[range.start * action_len..range.end * action_len])?;
            rewards[range.clone()].copy_from_slice(&batch.reward);
            for robot in 0..num_envs {
                done[range.start + robot] = batch.done(robot);
            }
            self.statistics.add(&self.obs, batch);
            for episode in &batch.ended {
                if batch.truncated[episode.env] {
                    let mut row = [&episode.final_obs[..], &episode.final_critic_obs].concat();
                    let raw = row.clone();
                    behaviour.normaliser.apply(&raw, &mut row);
                    truncated.push((range.start + episode.env, row));
                }
            }
            self.obs.copy_from_slice(&batch.obs);
            self.critic_obs.copy_from_slice(&batch.critic_obs);
        }
        self.estimate_advantages(behaviour, &spec);
        Ok(())
    }

    /// Normalises the current observations, and samples an action of each robot for the transitions `range`.
    fn sample_actions(&mut self, behaviour: &Behaviour, spec: &EnvSpec, range: std::ops::Range<usize>) {
        let (obs_len, critic_len) = (spec.obs_len(), spec.critic_obs_len());
        let (action_len, feature_len) = (spec.action_len(), obs_len + critic_len);
        let std: Vec<f32> = behaviour.log_std.iter().map(|log_std| log_std.exp()).collect();
        let mut raw = vec![0.0; feature_len * range.len()];
        for (robot, raw) in raw.chunks_exact_mut(feature_len).enumerate() {
            raw[..obs_len].copy_from_slice(&self.obs[robot * obs_len..][..obs_len]);
            raw[obs_len..].copy_from_slice(&self.critic_obs[robot * critic_len..][..critic_len]);
            let row = &mut self.segment.features[(range.start + robot) * feature_len..][..feature_len];
            behaviour.normaliser.apply(raw, row);
        }
        self.moments.update(&raw);
        let mut noise = vec![0.0; action_len];
        for first in range.clone().step_by(BLOCK) {
            let rows = BLOCK.min(range.end - first);
            for row in 0..rows {
                let features = &self.segment.features[(first + row) * feature_len..];
                self.actor.input(row)[..obs_len].copy_from_slice(&features[..obs_len]);
            }
            behaviour.actor.forward(&mut self.actor, rows);
            for row in 0..rows {
                let index = first + row;
                gaussian::fill_standard_normal(&mut self.random[index - range.start], &mut noise);
                let mean = &self.actor.output(row)[..action_len];
                let action = &mut self.segment.actions[index * action_len..][..action_len];
                for entry in 0..action_len {
                    action[entry] = mean[entry] + std[entry] * noise[entry];
                }
                self.segment.log_probs[index] = gaussian::log_probability(action, mean, behaviour.log_std);
            }
        }
    }

    fn estimate_advantages(&mut self, behaviour: &Behaviour, spec: &EnvSpec) {
        let (num_envs, feature_len) = (self.env.num_envs(), feature_len(spec));
        let mut last_features = vec![0.0; num_envs * feature_len];
        let (obs_len, critic_len) = (spec.obs_len(), spec.critic_obs_len());
        for (robot, row) in last_features.chunks_exact_mut(feature_len).enumerate() {
            let obs = &self.obs[robot * obs_len..][..obs_len];
            let critic_obs = &self.critic_obs[robot * critic_len..][..critic_len];
            behaviour.normaliser.apply(&[obs, critic_obs].concat(), row);
        }
        let Self { critic, segment, .. } = self;
        let mut evaluate = |rows: &[f32], values: &mut [f32]| {
            for (rows, values) in rows.chunks(BLOCK * feature_len).zip(values.chunks_mut(BLOCK)) {
                for (row, features) in rows.chunks_exact(feature_len).enumerate() {
                    critic.input(row)[..feature_len].copy_from_slice(features);
                }
                behaviour.critic.forward(critic, values.len());
                values.iter_mut().enumerate().for_each(|(row, value)| *value = critic.output(row)[0]);
            }
        };
        let mut last_values = vec![0.0; num_envs];
        evaluate(&segment.features, &mut segment.values);
        evaluate(&last_features, &mut last_values);
        let mut truncated_values = vec![0.0; segment.values.len()];
        for (index, features) in &segment.truncated {
            evaluate(features, &mut truncated_values[*index..=*index]);
        }
        let transitions = Transitions {
            num_envs,
            rewards: &segment.rewards,
            values: &segment.values,
            done: &segment.done,
            truncated_values: &truncated_values,
            last_values: &last_values,
        };
        advantages(&transitions, behaviour.discounts, &mut segment.advantages);
    }
}

/// Returns the length of the observations of both groups together.
pub fn feature_len(spec: &EnvSpec) -> usize {
    spec.obs_len() + spec.critic_obs_len()
}

/// Returns the seed of robot `robot`'s environment.
fn stream_seed(seed: u64, robot: u64) -> u64 {
    stream(seed, "environment", robot).next_u64()
}
