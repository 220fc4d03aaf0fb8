//! Checkpoints: the state of a training in one file, from which it can be resumed.

use std::path::Path;

use serde::{Deserialize, Serialize};
use twinstep_model::EnvSpec;
use twinstep_policy::array_file::{self, Array, ArrayFileError, Arrays, take};
use twinstep_policy::{CurvePoint, Normaliser, mlp_arrays, take_mlp};

use crate::adam::Adam;
use crate::trainer::Learner;

/// Metadata key of the header.
const KEY: &str = "checkpoint";
/// Names of the optimisers' parameters.
const OPTIMISED: [&str; 3] = ["actor", "critic", "log_std"];

/// State of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// What is learnt, with the state of the optimiser.
    pub learner: Learner,
    /// Layouts of the environments.
    pub spec: EnvSpec,
    /// Seed of the training.
    pub seed: u64,
    /// Settings of the training, as a config file (TOML).
    pub config: String,
    /// Learning curve so far.
    pub curve: Vec<CurvePoint>,
}

#[derive(Serialize, Deserialize)]
struct Header {
    spec: EnvSpec,
    seed: u64,
    config: String,
    curve: Vec<CurvePoint>,
    actor_sizes: Vec<usize>,
    critic_sizes: Vec<usize>,
    normaliser: Normaliser,
    optimiser_steps: [u32; 3],
    learning_rate: f32,
    iteration: u64,
    env_steps: u64,
}

impl Checkpoint {
    /// Writes a checkpoint (safetensors). The write is atomic.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), ArrayFileError> {
        let learner = &self.learner;
        let header = Header {
            spec: self.spec.clone(),
            seed: self.seed,
            config: self.config.clone(),
            curve: self.curve.clone(),
            actor_sizes: learner.actor.sizes().to_vec(),
            critic_sizes: learner.critic.sizes().to_vec(),
            normaliser: learner.normaliser.clone(),
            optimiser_steps: learner.optimisers.each_ref().map(|optimiser| optimiser.steps),
            learning_rate: learner.learning_rate,
            iteration: learner.iteration,
            env_steps: learner.env_steps,
        };
        let vector = |values: &Vec<f32>| Array { dimensions: vec![values.len()], values: values.clone() };
        let mut arrays = mlp_arrays("actor", &learner.actor);
        arrays.extend(mlp_arrays("mean_actor", &learner.mean_actor));
        arrays.extend(mlp_arrays("critic", &learner.critic));
        arrays.insert("log_std".to_owned(), vector(&learner.log_std));
        for (name, optimiser) in OPTIMISED.iter().zip(&learner.optimisers) {
            arrays.insert(format!("adam.{name}.first"), vector(&optimiser.first));
            arrays.insert(format!("adam.{name}.second"), vector(&optimiser.second));
        }
        array_file::write(path.as_ref(), KEY, &header, &arrays)
    }

    /// Reads a checkpoint.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ArrayFileError> {
        let path = path.as_ref();
        let (header, mut arrays): (Header, Arrays) = array_file::read(path, KEY)?;
        let problem = |problem: String| ArrayFileError::Content { path: path.to_owned(), problem };
        for (name, sizes) in [("actor_sizes", &header.actor_sizes), ("critic_sizes", &header.critic_sizes)] {
            if sizes.len() < 2 || sizes.iter().any(|size| !(1..=65_536).contains(size)) {
                return Err(problem(format!("has `{name}` = {sizes:?}, which is not a network")));
            }
        }
        let actor = take_mlp(&mut arrays, "actor", &header.actor_sizes, path)?;
        let mean_actor = take_mlp(&mut arrays, "mean_actor", &header.actor_sizes, path)?;
        let critic = take_mlp(&mut arrays, "critic", &header.critic_sizes, path)?;
        let log_std = take(&mut arrays, "log_std", &[actor.outputs()], path)?;
        let lengths = [actor.parameters.len(), critic.parameters.len(), log_std.len()];
        let mut optimisers = lengths.map(Adam::new);
        for (index, optimiser) in optimisers.iter_mut().enumerate() {
            let (name, len) = (OPTIMISED[index], lengths[index]);
            optimiser.steps = header.optimiser_steps[index];
            optimiser.first = take(&mut arrays, &format!("adam.{name}.first"), &[len], path)?;
            optimiser.second = take(&mut arrays, &format!("adam.{name}.second"), &[len], path)?;
        }
        let Normaliser { count, mean, variance, .. } = header.normaliser;
        if mean.len() != critic.inputs() || variance.len() != critic.inputs() || actor.inputs() > critic.inputs() {
            return Err(problem("has a `normaliser` that does not fit its networks".to_owned()));
        }
        let learner = Learner {
            actor,
            mean_actor,
            critic,
            log_std,
            normaliser: Normaliser::from_moments(count, mean, variance),
            optimisers,
            learning_rate: header.learning_rate,
            iteration: header.iteration,
            env_steps: header.env_steps,
        };
        Ok(Self { learner, spec: header.spec, seed: header.seed, config: header.config, curve: header.curve })
    }
}
