//! Gradient of the loss of proximal policy optimisation for a minibatch.
//!
//! Schulman et al., "Proximal policy optimization algorithms", 2017, eqs. 7 and 9, with a clipped value loss. The
//! minibatch is divided into a fixed number of shards, so that the sums do not depend on the number of threads.

use rayon::prelude::*;
use twinstep_policy::{Activations, Mlp, Network, gaussian};

use crate::PpoConfig;
use crate::rollout::{BLOCK, Segment};
use crate::symmetry::Mirror;

/// Number of shards of a minibatch; more threads than this are not used.
const SHARDS: usize = 16;

/// A transition: the group's index, and the index in its [`Segment`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Index of the group.
    pub group: u32,
    /// Index of the transition in the segment of the group.
    pub index: u32,
    /// True to learn from the mirror image of the transition.
    pub is_mirrored: bool,
}

/// Mirrors of features and actions.
#[derive(Clone, Debug)]
pub struct Mirrors {
    /// Mirror of the observations of both groups.
    pub features: Mirror,
    /// Mirror of the actions.
    pub actions: Mirror,
}

/// What the gradient of a minibatch is computed from.
pub struct Batch<'a> {
    /// Collected transitions of each group.
    pub segments: &'a [&'a Segment],
    /// Length of the observation of group `policy`.
    pub obs_len: usize,
    /// Length of the observations of both groups.
    pub feature_len: usize,
    /// Mean and standard deviation of all advantages.
    pub advantage_moments: [f32; 2],
    /// Set if samples may be mirrored.
    pub mirrors: Option<&'a Mirrors>,
}

/// Parameters at which the gradient is computed.
pub struct Parameters<'a> {
    /// The actor.
    pub actor: &'a Network,
    /// The critic.
    pub critic: &'a Network,
    /// Logarithm of the standard deviation of each entry of the action.
    pub log_std: &'a [f32],
}

/// Sums over the samples of a minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossSums {
    /// Clipped surrogate of the return, to be maximised.
    pub surrogate: f64,
    /// Squared error of the value.
    pub value: f64,
    /// Kullback–Leibler divergence from the policy that collected the samples [nat].
    pub kl: f64,
    /// Number of samples in `kl`.
    pub kl_samples: u64,
    /// Number of samples whose probability ratio was clipped.
    pub clipped: u64,
}

impl LossSums {
    /// Adds the sums over other samples.
    pub fn add(&mut self, other: &Self) {
        self.surrogate += other.surrogate;
        self.value += other.value;
        self.kl += other.kl;
        self.kl_samples += other.kl_samples;
        self.clipped += other.clipped;
    }

    /// Returns the mean Kullback–Leibler divergence [nat].
    pub fn mean_kl(&self) -> f64 {
        self.kl / self.kl_samples.max(1) as f64
    }
}

/// Sum of the gradients over a part of a minibatch.
#[derive(Clone, Debug)]
struct Shard {
    actor: Activations,
    critic: Activations,
    gradient: Gradient,
    losses: LossSums,
    mirrored_action: Vec<f32>,
    mean: Vec<f32>,
}

/// Gradient of the loss with respect to all parameters, summed over samples.
#[derive(Clone, Debug)]
pub struct Gradient {
    /// With respect to the parameters of the actor.
    pub actor: Vec<f32>,
    /// With respect to the parameters of the critic.
    pub critic: Vec<f32>,
    /// With respect to the logarithm of the standard deviation.
    pub log_std: Vec<f32>,
}

impl Gradient {
    fn new(actor: &Mlp, critic: &Mlp) -> Self {
        Self {
            actor: vec![0.0; actor.parameters.len()],
            critic: vec![0.0; critic.parameters.len()],
            log_std: vec![0.0; actor.outputs()],
        }
    }

    fn arrays(&self) -> [&[f32]; 3] {
        [&self.actor, &self.critic, &self.log_std]
    }

    fn arrays_mut(&mut self) -> [&mut Vec<f32>; 3] {
        [&mut self.actor, &mut self.critic, &mut self.log_std]
    }

    /// Returns the Euclidean norm.
    pub fn norm(&self) -> f64 {
        // Eight sums, which the compiler keeps in a register.
        let squares = |values: &[f32]| {
            let mut sums = [0.0f32; 8];
            for chunk in values.chunks(8) {
                chunk.iter().zip(&mut sums).for_each(|(value, sum)| *sum += value * value);
            }
            sums.into_iter().map(f64::from).sum::<f64>()
        };
        self.arrays().into_iter().map(squares).sum::<f64>().sqrt()
    }
}

/// Computes gradients of minibatches; owns the memory for it.
#[derive(Clone, Debug)]
pub struct GradientTask {
    shards: Vec<Shard>,
    /// Gradient of the last minibatch.
    pub gradient: Gradient,
}

impl GradientTask {
    /// Allocates the memory for gradients of `actor` and `critic`.
    pub fn new(actor: &Mlp, critic: &Mlp) -> Self {
        let gradient = Gradient::new(actor, critic);
        let shard = Shard {
            actor: Activations::new(actor, BLOCK),
            critic: Activations::new(critic, BLOCK),
            gradient: gradient.clone(),
            losses: LossSums::default(),
            mirrored_action: vec![0.0; actor.outputs()],
            mean: vec![0.0; actor.outputs()],
        };
        Self { shards: vec![shard; SHARDS], gradient }
    }

    /// Computes the gradient of the loss, summed over `samples`, into [`GradientTask::gradient`].
    pub fn run(&mut self, batch: &Batch, samples: &[Sample], parameters: &Parameters, config: &PpoConfig) -> LossSums {
        let part = samples.len().div_ceil(SHARDS);
        self.shards.par_iter_mut().enumerate().for_each(|(index, shard)| {
            let range = (index * part).min(samples.len())..((index + 1) * part).min(samples.len());
            shard.run(batch, &samples[range], parameters, config);
        });
        let mut losses = LossSums::default();
        self.shards.iter().for_each(|shard| losses.add(&shard.losses));
        for (index, sum) in self.gradient.arrays_mut().into_iter().enumerate() {
            sum.fill(0.0);
            for shard in &self.shards {
                sum.iter_mut().zip(shard.gradient.arrays()[index]).for_each(|(sum, value)| *sum += value);
            }
        }
        losses
    }
}

impl Shard {
    fn run(&mut self, batch: &Batch, samples: &[Sample], parameters: &Parameters, config: &PpoConfig) {
        self.gradient.arrays_mut().into_iter().for_each(|array| array.fill(0.0));
        self.losses = LossSums::default();
        for samples in samples.chunks(BLOCK) {
            for (row, sample) in samples.iter().enumerate() {
                self.write_input(batch, sample, row);
            }
            parameters.actor.forward(&mut self.actor, samples.len());
            parameters.critic.forward(&mut self.critic, samples.len());
            for (row, sample) in samples.iter().enumerate() {
                self.add_loss(batch, sample, row, parameters.log_std, config);
            }
            // The last block may have fewer rows than the pass, which have no loss.
            for row in samples.len()..self.actor.rows() {
                self.actor.output_gradient(row).fill(0.0);
                self.critic.output_gradient(row).fill(0.0);
            }
            parameters.actor.backward(&mut self.actor, samples.len(), &mut self.gradient.actor);
            parameters.critic.backward(&mut self.critic, samples.len(), &mut self.gradient.critic);
        }
    }

    fn write_input(&mut self, batch: &Batch, sample: &Sample, row: usize) {
        let Batch { obs_len, feature_len, .. } = *batch;
        let features = &batch.segments[sample.group as usize].features[sample.index as usize * feature_len..];
        let input = &mut self.critic.input(row)[..feature_len];
        match batch.mirrors.filter(|_| sample.is_mirrored) {
            Some(mirrors) => mirrors.features.apply(&features[..feature_len], input),
            None => input.copy_from_slice(&features[..feature_len]),
        }
        self.actor.input(row)[..obs_len].copy_from_slice(&input[..obs_len]);
    }

    /// Adds the loss of a sample, and sets its gradient with respect to the outputs of the networks.
    fn add_loss(&mut self, batch: &Batch, sample: &Sample, row: usize, log_std: &[f32], config: &PpoConfig) {
        let (segment, index) = (batch.segments[sample.group as usize], sample.index as usize);
        let (action_len, clip) = (log_std.len(), config.clip);
        let mut action = &segment.actions[index * action_len..][..action_len];
        if let Some(mirrors) = batch.mirrors.filter(|_| sample.is_mirrored) {
            mirrors.actions.apply(action, &mut self.mirrored_action);
            action = &self.mirrored_action;
        }
        self.mean.copy_from_slice(&self.actor.output(row)[..action_len]);
        let log_ratio = gaussian::log_probability(action, &self.mean, log_std) - segment.log_probs[index];
        let ratio = log_ratio.exp();
        let [advantage_mean, advantage_std] = batch.advantage_moments;
        let advantage = (segment.advantages[index] - advantage_mean) / advantage_std;
        let clipped_ratio = ratio.clamp(1.0 - clip, 1.0 + clip);
        // The smaller of the two; the clipped one has no gradient.
        let is_clipped = clipped_ratio * advantage < ratio * advantage;
        self.losses.surrogate += f64::from((ratio * advantage).min(clipped_ratio * advantage));
        // The mirrored action was not sampled from the policy, so its divergence does not measure the update.
        if !sample.is_mirrored {
            self.losses.kl += f64::from(ratio - 1.0 - log_ratio);
            self.losses.kl_samples += 1;
        }
        self.losses.clipped += u64::from(is_clipped);
        let factor = if is_clipped { 0.0 } else { -ratio * advantage };
        let mean_gradient = self.actor.output_gradient(row);
        for entry in 0..action_len {
            let inverse_std = (-log_std[entry]).exp();
            let z = (action[entry] - self.mean[entry]) * inverse_std;
            mean_gradient[entry] = factor * z * inverse_std;
            self.gradient.log_std[entry] += factor * (z * z - 1.0) - config.entropy_weight;
        }

        let (value, old_value) = (self.critic.output(row)[0], segment.values[index]);
        let target = old_value + segment.advantages[index];
        let near_value = old_value + (value - old_value).clamp(-clip, clip);
        let (error, near_error) = (value - target, near_value - target);
        // The larger error counts; a value that was clipped has no gradient.
        let uses_near = near_error * near_error > error * error;
        let gradient = if uses_near && near_value != value { 0.0 } else { 2.0 * error };
        self.losses.value += f64::from((error * error).max(near_error * near_error));
        self.critic.output_gradient(row)[0] = config.value_weight * gradient;
    }
}
