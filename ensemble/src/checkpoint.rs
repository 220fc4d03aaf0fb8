//! State of an interrupted training, in memory and as a file.

use std::path::Path;

use serde::{Deserialize, Serialize};
use twinstep_model::stream;

use crate::EnsembleError;
use crate::file::{Arrays, Bytes, write};
use crate::metadata::EnsembleMetadata;
use crate::training_options::TrainingOptions;
use crate::weights::{Shape, Weights};

/// State of every member at the end of its last epoch. A resumed training gives bitwise equal results.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    options: TrainingOptions,
    data_hash: String,
    shape: Shape,
    pub(crate) members: Vec<MemberState>,
}

/// State of one member.
#[derive(Clone, Debug)]
pub struct MemberState {
    /// Weights after the last epoch.
    pub weights: Weights,
    /// Weights with the lowest validation loss so far.
    pub best: Weights,
    /// State of the optimiser in burn's format; empty before the first epoch.
    pub optimizer: Vec<u8>,
    /// Epochs so far.
    pub curve: Vec<Epoch>,
}

/// Losses of one epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Mean negative log-likelihood of the training rows during the epoch, of torque in N·m [nat].
    pub training_nll: f64,
    /// Mean negative log-likelihood of the validation rows after the epoch [nat].
    pub validation_nll: f64,
}

/// Metadata of the file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    options: TrainingOptions,
    data_hash: String,
    inputs: usize,
    curves: Vec<Vec<Epoch>>,
}

impl Checkpoint {
    /// Creates the initial state of a training, with the weights in `initial` or sampled ones.
    pub(crate) fn new(options: TrainingOptions, description: &EnsembleMetadata, initial: Option<&[Weights]>) -> Self {
        let shape = description.shape();
        let member = |index: usize| {
            let sampled = || shape.random(&mut stream(options.seed, "first weights", index as u64));
            let weights = initial.map_or_else(sampled, |initial| initial[index].clone());
            MemberState { best: weights.clone(), weights, optimizer: Vec::new(), curve: Vec::new() }
        };
        let members = (0..options.members).map(member).collect();
        Self { data_hash: description.data_hash.clone(), shape, members, options }
    }

    /// Checks that the checkpoint is of a training with these options and data. The number of epochs may differ.
    pub(crate) fn of(mut self, options: &TrainingOptions, data_hash: &str) -> Result<Self, EnsembleError> {
        let mut saved = self.options;
        saved.epochs = options.epochs;
        if saved != *options {
            return Err(EnsembleError::OtherTraining { what: "settings" });
        }
        if self.data_hash != data_hash {
            return Err(EnsembleError::OtherTraining { what: "data" });
        }
        self.options = saved;
        Ok(self)
    }

    /// Returns the epochs of each member.
    pub fn curves(&self) -> impl Iterator<Item = &[Epoch]> {
        self.members.iter().map(|member| member.curve.as_slice())
    }

    /// Writes a safetensors file atomically.
    pub fn write(&self, path: &Path) -> Result<(), EnsembleError> {
        let mut arrays = Vec::new();
        for (index, member) in self.members.iter().enumerate() {
            for (role, weights) in [("weights", &member.weights), ("best", &member.best)] {
                arrays.extend(self.shape.layout().into_iter().map(|(name, dimensions)| {
                    (format!("{index}.{role}.{name}"), Bytes::floats(dimensions, &weights[name]))
                }));
            }
            arrays.push((format!("{index}.optimizer"), Bytes::plain(member.optimizer.clone())));
        }
        let header = Header {
            options: self.options.clone(),
            data_hash: self.data_hash.clone(),
            inputs: self.shape.inputs,
            curves: self.members.iter().map(|member| member.curve.clone()).collect(),
        };
        write(path, "training", &header, arrays)
    }

    /// Reads a file of [`Checkpoint::write`].
    pub fn read(path: &Path) -> Result<Self, EnsembleError> {
        let arrays = Arrays::read(path)?;
        let Header { options, data_hash, inputs, curves } = arrays.header("training")?;
        let shape = Shape { inputs, hidden: options.hidden };
        let mut members = Vec::new();
        for (index, curve) in curves.into_iter().enumerate() {
            members.push(MemberState {
                weights: arrays.weights(shape, &format!("{index}.weights"))?,
                best: arrays.weights(shape, &format!("{index}.best"))?,
                optimizer: arrays.bytes(&format!("{index}.optimizer"))?,
                curve,
            });
        }
        if members.len() != options.members {
            return Err(arrays.problem(format!("has {} of {} members", members.len(), options.members)));
        }
        Ok(Self { options, data_hash, shape, members })
    }
}
