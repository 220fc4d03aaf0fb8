//! Normalisation of inputs and outputs to zero mean and unit standard deviation.

use serde::{Deserialize, Serialize};

use crate::data::{DataSet, Split};

/// Mean and standard deviation of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normaliser {
    /// Mean.
    pub mean: f64,
    /// Standard deviation, greater than 0.
    #[serde(rename = "deviation")]
    pub std: f64,
}

/// Normalisers of the inputs and the output of a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalisers {
    /// Normalisers of the two numbers of [`crate::NetworkInput`].
    #[serde(rename = "errors")]
    pub inputs: [Normaliser; 2],
    /// Normaliser of the torque [N·m].
    pub torque: Normaliser,
}

impl Normaliser {
    /// Computes the normaliser of `values`. The standard deviation of constant values is set to 1.
    fn of(values: impl Iterator<Item = f64> + Clone) -> Self {
        let count = values.clone().count().max(1) as f64;
        let mean = values.clone().sum::<f64>() / count;
        let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        Self { mean, std: if variance > 0.0 { variance.sqrt() } else { 1.0 } }
    }

    /// Returns the normalised value.
    pub(crate) fn normalise(self, value: f64) -> f32 {
        ((value - self.mean) / self.std) as f32
    }
}

impl Normalisers {
    /// Computes the normalisers of the training split.
    pub(crate) fn of(data: &DataSet) -> Self {
        let input = |index: usize| {
            Normaliser::of(
                data.runs(Split::Training).flat_map(move |run| run.inputs.iter().map(move |input| input[index])),
            )
        };
        let torque = Normaliser::of(data.runs(Split::Training).flat_map(|run| run.torques.iter().copied()));
        Self { inputs: [input(0), input(1)], torque }
    }
}
