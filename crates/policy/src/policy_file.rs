//! The policy file: weights and normaliser with everything that must agree with the robot.
//!
//! A safetensors file. Arrays of 32-bit floats: `actor.<layer>.weight` (outputs × inputs, as in PyTorch) and
//! `actor.<layer>.bias`, `log_std`, `normaliser.mean` and `normaliser.std`. The metadata key `policy` has a
//! [`PolicyHeader`] as JSON. The action is
//! `actor(clip((obs − mean) / std, −10, 10))`, with rectified linear units between the layers.

use std::path::Path;

use serde::{Deserialize, Serialize};
use twinstep_model::EnvSpec;

use crate::array_file::{Array, ArrayFileError, Arrays, read, take, write};
use crate::mlp::{Mlp, transposed};
use crate::normaliser::Normaliser;
use crate::policy::Policy;

/// Metadata key of the header.
const KEY: &str = "policy";
/// Version of the format.
const FORMAT: u32 = 2;
/// Earlier version: its hash does not contain the robot's name.
const FORMAT_WITHOUT_ROBOT: u32 = 1;

/// Header of a policy file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PolicyHeader {
    /// Version of the format: 2, or 1.
    pub format: u32,
    /// Hash of the spec: what agent and robot must agree on.
    pub spec_hash: String,
    /// Layouts, periods, gains, action scale and default pose.
    pub spec: EnvSpec,
    /// Numbers of inputs, of units of each hidden layer, and of outputs.
    pub actor_sizes: Vec<usize>,
    /// How the policy was made.
    pub origin: PolicyOrigin,
}

/// How a policy was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PolicyOrigin {
    /// Command line of the training.
    pub command: String,
    /// Version of the program.
    pub version: String,
    /// Git revision of the program's sources. `None` if it was built outside a repository.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<String>,
    /// Seed of the training.
    pub seed: u64,
    /// Settings of the training, as a config file (TOML).
    pub config: String,
    /// Number of environment steps.
    pub env_steps: u64,
    /// Learning curve.
    pub curve: Vec<CurvePoint>,
}

/// A point of a learning curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Number of environment steps so far.
    pub env_steps: u64,
    /// Time since the start [s].
    pub seconds: f64,
    /// Mean reward per step.
    pub reward: f64,
    /// Root mean square error of the horizontal velocity [m/s]; `None` if it is not observed.
    pub velocity_rms: Option<f64>,
    /// Root mean square error of the yaw rate [rad/s]; `None` if it is not observed.
    pub yaw_rate_rms: Option<f64>,
    /// Falls per robot and minute of simulated time [1/min].
    pub falls_per_minute: f64,
    /// Mean level of the robots on a course of patches; the first is 0. `None` without a course.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_level: Option<f64>,
}

impl Policy {
    /// Writes a policy file. The write is atomic.
    pub fn write(&self, path: impl AsRef<Path>, origin: PolicyOrigin) -> Result<(), ArrayFileError> {
        let header = PolicyHeader {
            format: FORMAT,
            spec_hash: self.spec.hash(),
            spec: self.spec.clone(),
            actor_sizes: self.actor.sizes().to_vec(),
            origin,
        };
        let mut arrays = mlp_arrays("actor", &self.actor);
        let (mean, std) = self.normaliser.mean_and_std();
        for (name, values) in [("normaliser.mean", mean), ("normaliser.std", std), ("log_std", self.log_std.clone())] {
            arrays.insert(name.to_owned(), Array { dimensions: vec![values.len()], values });
        }
        write(path.as_ref(), KEY, &header, &arrays)
    }

    /// Reads a policy file, with its header.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, PolicyHeader), ArrayFileError> {
        let path = path.as_ref();
        let problem = |problem: String| Err(ArrayFileError::Content { path: path.to_owned(), problem });
        let (header, mut arrays): (PolicyHeader, Arrays) = read(path, KEY)?;
        let PolicyHeader { format, spec_hash, spec, actor_sizes, .. } = &header;
        if ![FORMAT_WITHOUT_ROBOT, FORMAT].contains(format) {
            return problem(format!("has `format` = {format}; this program reads {FORMAT_WITHOUT_ROBOT} and {FORMAT}"));
        }
        if *format == FORMAT && *spec_hash != spec.hash() {
            return problem(format!("has `spec_hash` = {spec_hash}, but its spec has {}", spec.hash()));
        }
        let ends = (actor_sizes.first().copied(), actor_sizes.last().copied());
        let expected = (Some(spec.obs_len()), Some(spec.action_len()));
        if actor_sizes.len() < 2 || ends != expected || actor_sizes.iter().any(|size| !(1..=65_536).contains(size)) {
            return problem(format!("has `actor_sizes` = {actor_sizes:?}, which does not fit its spec"));
        }
        let actor = take_mlp(&mut arrays, "actor", actor_sizes, path)?;
        let mean = take(&mut arrays, "normaliser.mean", &[spec.obs_len()], path)?;
        let std = take(&mut arrays, "normaliser.std", &[spec.obs_len()], path)?;
        if let Some(value) = std.iter().find(|value| **value <= 0.0) {
            return problem(format!("has {value} in `normaliser.std`, which must be positive"));
        }
        let log_std = take(&mut arrays, "log_std", &[spec.action_len()], path)?;
        let policy =
            Self { spec: spec.clone(), normaliser: Normaliser::from_mean_and_std(&mean, &std), actor, log_std };
        Ok((policy, header))
    }
}

/// Returns the arrays `<name>.<layer>.weight` (outputs × inputs) and `<name>.<layer>.bias` of a network.
pub fn mlp_arrays(name: &str, network: &Mlp) -> Arrays {
    let mut arrays = Arrays::new();
    for (index, layer) in network.layers().iter().enumerate() {
        let (weight, bias) = network.layer(index);
        let values = transposed(&weight, layer.inputs);
        arrays
            .insert(format!("{name}.{index}.weight"), Array { dimensions: vec![layer.outputs, layer.inputs], values });
        arrays.insert(format!("{name}.{index}.bias"), Array { dimensions: vec![layer.outputs], values: bias });
    }
    arrays
}

/// Removes the arrays of a network from `arrays`.
pub fn take_mlp(arrays: &mut Arrays, name: &str, sizes: &[usize], path: &Path) -> Result<Mlp, ArrayFileError> {
    // The sizes are only a claim until the file has all arrays: before, no memory is reserved for them.
    let mut layers = Vec::new();
    for (index, pair) in sizes.windows(2).enumerate() {
        let weight = take(arrays, &format!("{name}.{index}.weight"), &[pair[1], pair[0]], path)?;
        let bias = take(arrays, &format!("{name}.{index}.bias"), &[pair[1]], path)?;
        layers.push((transposed(&weight, pair[1]), bias));
    }
    let mut network = Mlp::zeros(sizes);
    for (index, (weight, bias)) in layers.iter().enumerate() {
        network.set_layer(index, weight, bias);
    }
    Ok(network)
}
