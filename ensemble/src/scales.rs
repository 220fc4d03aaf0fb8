//! What is large and what is small in a data set: networks compute in its deviations.

use serde::{Deserialize, Serialize};

use crate::data::{Split, DataSet};

/// Mean and standard deviation of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normaliser {
    /// Its mean.
    pub mean: f64,
    /// Its standard deviation, greater than 0.
    pub std: f64,
}

/// What is 0 and what is 1 to a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalisers {
    /// Of Δq [rad] and Δq̇ [rad/s].
    pub errors: [Normaliser; 2],
    /// Of torque [N·m].
    pub torque: Normaliser,
}

impl Normaliser {
    /// Of `values`; a quantity that never changes has the deviation 1.
    fn of(values: impl Iterator<Item = f64> + Clone) -> Self {
        let count = values.clone().count().max(1) as f64;
        let mean = values.clone().sum::<f64>() / count;
        let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        Self { mean, std: if variance > 0.0 { variance.sqrt() } else { 1.0 } }
    }

    /// To a network's unit.
    pub(crate) fn normalise(self, value: f64) -> f32 {
        ((value - self.mean) / self.std) as f32
    }
}

impl Normalisers {
    /// Of the rows that are learnt from.
    pub(crate) fn of(data: &DataSet) -> Self {
        let error = |index: usize| {
            Normaliser::of(data.runs(Split::Training).flat_map(move |run| run.errors.iter().map(move |error| error[index])))
        };
        let torque = Normaliser::of(data.runs(Split::Training).flat_map(|run| run.torques.iter().copied()));
        Self { errors: [error(0), error(1)], torque }
    }
}
