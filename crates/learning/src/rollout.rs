//! Transitions of a group of robots: the trajectory that the current policy collected, with values and advantages.

use rand::Rng;
use twinstep_model::{EnvError, EnvSpec, Trajectory, stream};
use twinstep_policy::{Activations, BehaviourPolicy, Collector, Mlp, Network, Normaliser};

use crate::gae::{Discounts, Transitions, advantages};
use crate::statistics::Statistics;

/// Number of rows that are evaluated together, so that they stay in the processor's cache.
pub const BLOCK: usize = 64;

/// Policy, critic and normaliser while transitions are collected.
pub struct Behaviour<'a> {
    /// The policy.
    pub policy: &'a BehaviourPolicy,
    /// Seed of the noise of robot 0; robot `i` has this plus `i`.
    pub noise_seed: u64,
    /// Network from the normalised observations of both groups to the value.
    pub critic: &'a Network,
    /// Moments of the observations of both groups, `policy` first.
    pub normaliser: &'a Normaliser,
    /// Discounts of the advantage estimator.
    pub discounts: Discounts,
}

/// Transitions of a group of robots, row-major: `[step][robot]`. Empty if the robots could not be reached.
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
}

/// Robots that are stepped together, and their transitions.
pub struct Group {
    collector: Box<dyn Collector>,
    spec: EnvSpec,
    first_robot: u64,
    horizon: usize,
    trajectory: Trajectory,
    critic: Activations,
    /// Transitions of the last rollout.
    pub segment: Segment,
    /// Moments of the observations of the last rollout.
    pub moments: Normaliser,
    /// Rewards, falls and velocity errors of the last rollout.
    pub statistics: Statistics,
}

impl Group {
    /// Resets the robots of `collector` with the seeds from `seed` on. `first_robot` is the index of its first robot.
    pub fn new(
        mut collector: Box<dyn Collector>,
        critic: &Mlp,
        horizon: usize,
        seed: u64,
        first_robot: usize,
    ) -> Result<Self, EnvError> {
        let (spec, first_robot) = (collector.spec().clone(), first_robot as u64);
        let robots = first_robot..first_robot + collector.num_envs() as u64;
        collector.reset(&robots.map(|robot| stream_seed(seed, robot)).collect::<Vec<_>>())?;
        Ok(Self {
            first_robot,
            horizon,
            trajectory: Trajectory::default(),
            critic: Activations::new(critic, BLOCK),
            segment: Segment::default(),
            moments: Normaliser::identity(feature_len(&spec)),
            statistics: Statistics::new(&spec),
            spec,
            collector,
        })
    }

    /// Runs `policy` for this number of steps, from which nothing is learnt.
    pub fn advance(&mut self, policy: &BehaviourPolicy, noise_seed: u64, steps: usize) -> Result<(), EnvError> {
        let noise_seed = noise_seed.wrapping_add(self.first_robot);
        let mut left = steps;
        while left > 0 {
            let steps = left.min(self.horizon);
            self.collector.send(policy, noise_seed, steps)?;
            if !self.collector.collect(policy, noise_seed, steps, &mut self.trajectory)? {
                break;
            }
            left -= steps;
        }
        Ok(())
    }

    /// Sends the request for a rollout, if the robots are on a server. [`Group::collect`] follows.
    pub fn send(&mut self, behaviour: &Behaviour) -> Result<(), EnvError> {
        self.collector.send(behaviour.policy, behaviour.noise_seed.wrapping_add(self.first_robot), self.horizon)
    }

    /// Steps the robots `horizon` times, and estimates the advantages.
    pub fn collect(&mut self, behaviour: &Behaviour) -> Result<(), EnvError> {
        let Self { collector, spec, trajectory, horizon, segment, .. } = self;
        self.moments = Normaliser::identity(feature_len(spec));
        self.statistics = Statistics::new(spec);
        let noise_seed = behaviour.noise_seed.wrapping_add(self.first_robot);
        if !collector.collect(behaviour.policy, noise_seed, *horizon, trajectory)? {
            *segment = Segment::default();
            return Ok(());
        }
        std::mem::swap(&mut segment.actions, &mut trajectory.actions);
        std::mem::swap(&mut segment.log_probs, &mut trajectory.log_prob);
        self.statistics.add(trajectory);
        if let Some(level) = collector.mean_level() {
            self.statistics.add_level(level, collector.num_envs());
        }
        let last_features = self.normalise(behaviour);
        self.estimate_advantages(behaviour, &last_features);
        Ok(())
    }

    /// Writes the normalised observations before each step, and adds them to the moments. Returns those after the last.
    fn normalise(&mut self, behaviour: &Behaviour) -> Vec<f32> {
        let Self { spec, trajectory, segment, moments, .. } = self;
        let (feature_len, num_envs) = (feature_len(spec), trajectory.num_envs);
        let mut raw = vec![0.0; num_envs * feature_len];
        let mut normalised = |step: usize, features: &mut [f32]| {
            for (robot, row) in raw.chunks_exact_mut(feature_len).enumerate() {
                let index = step * num_envs + robot;
                let (obs, critic_obs) = row.split_at_mut(spec.obs_len());
                obs.copy_from_slice(&trajectory.obs[index * obs.len()..][..obs.len()]);
                critic_obs.copy_from_slice(&trajectory.critic_obs[index * critic_obs.len()..][..critic_obs.len()]);
                behaviour.normaliser.apply(row, &mut features[robot * feature_len..][..feature_len]);
            }
            if step < trajectory.steps {
                moments.update(&raw);
            }
        };
        segment.features.resize(trajectory.steps * num_envs * feature_len, 0.0);
        for (step, features) in segment.features.chunks_exact_mut(num_envs * feature_len).enumerate() {
            normalised(step, features);
        }
        let mut last_features = vec![0.0; num_envs * feature_len];
        normalised(trajectory.steps, &mut last_features);
        last_features
    }

    fn estimate_advantages(&mut self, behaviour: &Behaviour, last_features: &[f32]) {
        let Self { critic, spec, trajectory, segment, .. } = self;
        let (num_envs, feature_len) = (trajectory.num_envs, feature_len(spec));
        let len = trajectory.steps * num_envs;
        segment.values.resize(len, 0.0);
        segment.advantages.resize(len, 0.0);
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
        evaluate(last_features, &mut last_values);
        let mut truncated_values = vec![0.0; len];
        for (step, episode) in &trajectory.ended {
            let index = step * num_envs + episode.env;
            if trajectory.truncated[index] {
                let raw = [&episode.final_obs[..], &episode.final_critic_obs].concat();
                let mut features = vec![0.0; feature_len];
                behaviour.normaliser.apply(&raw, &mut features);
                evaluate(&features, &mut truncated_values[index..=index]);
            }
        }
        let done: Vec<bool> =
            trajectory.terminated.iter().zip(&trajectory.truncated).map(|(one, other)| one | other).collect();
        let transitions = Transitions {
            num_envs,
            rewards: &trajectory.reward,
            values: &segment.values,
            done: &done,
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
