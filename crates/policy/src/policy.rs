//! A policy: normaliser, actor network and exploration noise.

use twinstep_model::EnvSpec;

use crate::mlp::Mlp;
use crate::network::{Activations, Network};
use crate::normaliser::Normaliser;

/// Number of rows that are evaluated together, so that they stay in the processor's cache.
const BLOCK: usize = 64;

/// A policy with everything that must agree with the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Policy {
    /// Layouts, gains and default pose of the environment in which it was trained.
    pub spec: EnvSpec,
    /// Moments of the observations of group `policy`.
    pub normaliser: Normaliser,
    /// Network from normalised observations to the mean action.
    pub actor: Mlp,
    /// Logarithm of the standard deviation of each entry of the action while it was trained.
    pub log_std: Vec<f32>,
}

/// Evaluates a policy on many observations.
#[derive(Clone, Debug)]
pub struct PolicyRunner {
    network: Network,
    activations: Activations,
    outputs: usize,
    normaliser: Normaliser,
}

impl PolicyRunner {
    /// Prepares the evaluation of `policy`.
    pub fn new(policy: &Policy) -> Self {
        Self::from_parts(&policy.actor, &policy.normaliser)
    }

    /// Prepares the evaluation of a network on observations that `normaliser` normalises.
    pub fn from_parts(network: &Mlp, normaliser: &Normaliser) -> Self {
        Self {
            network: Network::new(network),
            activations: Activations::new(network, BLOCK),
            outputs: network.outputs(),
            normaliser: normaliser.clone(),
        }
    }

    /// Writes the outputs of each observation. `obs` are rows of the normaliser's length, `outputs` rows of the network's.
    pub fn run(&mut self, obs: &[f32], outputs: &mut [f32]) {
        let Self { network, activations, normaliser, .. } = self;
        let len = normaliser.len();
        for (obs, outputs) in obs.chunks(BLOCK * len).zip(outputs.chunks_mut(BLOCK * self.outputs)) {
            for (row, obs) in obs.chunks_exact(len).enumerate() {
                normaliser.apply(obs, activations.input(row));
            }
            network.forward(activations, obs.len() / len);
            for (row, output) in outputs.chunks_exact_mut(self.outputs).enumerate() {
                output.copy_from_slice(&activations.output(row)[..output.len()]);
            }
        }
    }
}
