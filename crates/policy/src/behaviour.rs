//! The policy that collects transitions: a normal distribution of actions around the output of a network.

use std::borrow::Borrow;
use std::hash::{DefaultHasher, Hasher};
use std::sync::OnceLock;

use rand::Rng;
use twinstep_model::{EnvError, Stream, Trajectory, VecEnv, stream};

use crate::gaussian;
use crate::mlp::Mlp;
use crate::network::{Activations, Network};
use crate::normaliser::Normaliser;

/// Number of rows that are evaluated together, so that they stay in the processor's cache.
const BLOCK: usize = 64;

/// A policy that explores: its actions are samples.
#[derive(Clone, Debug)]
pub struct BehaviourPolicy {
    actor: Mlp,
    normaliser: Normaliser,
    log_std: Vec<f32>,
    network: Network,
    /// Weights and fingerprint, computed when a policy is sent first.
    sent: OnceLock<(Vec<f32>, u64)>,
}

impl BehaviourPolicy {
    /// Creates a policy. `actor` maps the normalised observation of group `policy` to the mean action; `log_std` is the
    /// logarithm of the standard deviation of each entry.
    ///
    /// Panics if the sizes do not fit each other.
    pub fn new(actor: Mlp, normaliser: Normaliser, log_std: Vec<f32>) -> Self {
        assert_eq!((actor.inputs(), actor.outputs()), (normaliser.len(), log_std.len()), "sizes of the policy");
        Self { network: Network::forward_only(&actor), actor, normaliser, log_std, sent: OnceLock::new() }
    }

    /// Returns a hash of everything that decides on the actions, the same within this process.
    pub fn fingerprint(&self) -> u64 {
        self.sent().1
    }

    /// Returns [`Mlp::weights`] of the actor.
    pub fn weights(&self) -> &[f32] {
        &self.sent().0
    }

    fn sent(&self) -> &(Vec<f32>, u64) {
        self.sent.get_or_init(|| (self.actor.weights(), self.hash()))
    }

    fn hash(&self) -> u64 {
        let (mean, std) = self.normaliser.mean_and_std();
        let mut hasher = DefaultHasher::new();
        self.actor.sizes().iter().for_each(|size| hasher.write_usize(*size));
        for values in [&self.actor.parameters, &mean, &std, &self.log_std] {
            for pair in values.chunks(2) {
                let bits = |index: usize| pair.get(index).map_or(0, |value| u64::from(value.to_bits()));
                hasher.write_u64(bits(0) | bits(1) << 32);
            }
        }
        hasher.finish()
    }

    /// Returns the network from normalised observations to the mean action.
    pub fn actor(&self) -> &Mlp {
        &self.actor
    }

    /// Returns mean and standard deviation of the observations.
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// Returns the logarithm of the standard deviation of each entry of the action.
    pub fn log_std(&self) -> &[f32] {
        &self.log_std
    }
}

/// Samples the actions of consecutive steps, with a policy that it borrows or shares.
pub struct ActionSampler<P> {
    policy: P,
    random: Vec<Stream>,
    activations: Activations,
    std: Vec<f32>,
    noise: Vec<f32>,
}

impl<P: Borrow<BehaviourPolicy>> ActionSampler<P> {
    /// Starts the noise of `num_envs` environments. That of environment `i` is a function of `noise_seed + i` alone.
    pub fn new(policy: P, noise_seed: u64, num_envs: usize) -> Self {
        let BehaviourPolicy { actor, log_std, .. } = policy.borrow();
        let seeds = (0..num_envs as u64).map(|env| noise_seed.wrapping_add(env));
        Self {
            random: seeds.map(|seed| stream(seed, "action", 0)).collect(),
            activations: Activations::forward_only(actor, BLOCK),
            std: log_std.iter().map(|log_std| log_std.exp()).collect(),
            noise: vec![0.0; log_std.len()],
            policy,
        }
    }

    /// Samples actions for the last observations of `trajectory`, steps `env` with them, and appends the step.
    ///
    /// If it fails, the trajectory is that before the step.
    pub fn step(&mut self, env: &mut dyn VecEnv, trajectory: &mut Trajectory) -> Result<(), EnvError> {
        let (step, num_envs, action_len) = (trajectory.steps, trajectory.num_envs, self.noise.len());
        let obs_len = self.policy.borrow().normaliser.len();
        let obs = &trajectory.obs[step * num_envs * obs_len..][..num_envs * obs_len];
        let actions = &mut trajectory.actions[step * num_envs * action_len..][..num_envs * action_len];
        let log_prob = &mut trajectory.log_prob[step * num_envs..][..num_envs];
        self.sample(obs, actions, log_prob);
        let batch = env.step(actions)?;
        trajectory.push(batch);
        Ok(())
    }

    fn sample(&mut self, obs: &[f32], actions: &mut [f32], log_prob: &mut [f32]) {
        let Self { policy, random, activations, std, noise } = self;
        let policy: &BehaviourPolicy = (*policy).borrow();
        let (obs_len, action_len) = (policy.normaliser.len(), noise.len());
        let blocks = obs.chunks(BLOCK * obs_len).zip(actions.chunks_mut(BLOCK * action_len));
        let blocks = blocks.zip(log_prob.chunks_mut(BLOCK)).zip(random.chunks_mut(BLOCK));
        for (((obs, actions), log_prob), random) in blocks {
            for (row, obs) in obs.chunks_exact(obs_len).enumerate() {
                policy.normaliser.apply(obs, activations.input(row));
            }
            policy.network.forward(activations, random.len());
            for (row, action) in actions.chunks_exact_mut(action_len).enumerate() {
                let mean = &activations.output(row)[..action_len];
                gaussian::fill_standard_normal(&mut random[row], noise);
                for entry in 0..action_len {
                    action[entry] = mean[entry] + std[entry] * noise[entry];
                }
                log_prob[row] = gaussian::log_probability(action, mean, &policy.log_std);
            }
        }
    }
}

/// Returns a seed for the noise of rollout `index` of a training with `seed`.
pub fn noise_seed(seed: u64, index: u64) -> u64 {
    stream(seed, "noise", index).next_u64()
}
