//! Options of a training.

use serde::{Deserialize, Serialize};

use crate::EnsembleError;
use crate::metadata::JointEncoding;

/// Options of a training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingOptions {
    /// Number of networks.
    pub members: usize,
    /// Number of LSTM units.
    pub hidden: usize,
    /// Encoding of the joint in the input.
    pub joint_input: JointEncoding,
    /// Maximum number of epochs.
    pub epochs: usize,
    /// Seed of initial weights and order of the data. Equal seeds give equal ensembles for any number of threads.
    pub seed: u64,
}

impl Default for TrainingOptions {
    /// Six members as in U2E.
    fn default() -> Self {
        Self { members: 6, hidden: 32, joint_input: JointEncoding::Pooled, epochs: 100, seed: 0 }
    }
}

impl TrainingOptions {
    /// Checks that every option is in its range.
    pub(crate) fn check(&self) -> Result<(), EnsembleError> {
        for (option, given, max) in
            [("members", self.members, 100), ("hidden", self.hidden, 512), ("epochs", self.epochs, 100_000)]
        {
            if !(1..=max).contains(&given) {
                return Err(EnsembleError::Option { option, given, most: max });
            }
        }
        Ok(())
    }
}
