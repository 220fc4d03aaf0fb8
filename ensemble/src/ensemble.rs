//! An ensemble of trained networks and its metadata.

use burn::tensor::Device;

use crate::EnsembleError;
use crate::data::Sequence;
use crate::metadata::EnsembleMetadata;
use crate::network::Network;
use crate::sequences::{BURN_IN_ROWS, SequenceDataset};
use crate::weights::Weights;

/// Number of sequences per batch in a prediction.
const PREDICTION_BATCH: usize = 256;

/// Relative difference of rates that are taken as equal.
const RATE_TOLERANCE: f64 = 0.02;

/// Predictive distribution of a torque.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    /// Mean [N·m].
    pub mean: f64,
    /// Variance [N²·m²].
    pub variance: f64,
}

/// Networks trained on the same data, with different initial weights and orders of the data.
#[derive(Clone, Debug, PartialEq)]
pub struct Ensemble {
    /// Properties of the training data and the networks.
    pub description: EnsembleMetadata,
    pub(crate) members: Vec<Weights>,
}

impl Ensemble {
    /// Checks that the time step of the ensemble is `dt` [s]. `what` describes the caller in the error.
    pub fn check_step(&self, what: &str, dt: f64) -> Result<(), EnsembleError> {
        let expected = self.description.dt;
        if (dt / expected - 1.0).abs() <= 1e-6 {
            return Ok(());
        }
        Err(EnsembleError::TimeStepMismatch { what: what.to_owned(), given: dt, expected })
    }

    /// Checks that the networks are not faster than an actuator with the period `dt` [s]. `what` describes the actuator in
    /// the error. At a lower rate their torque is held.
    pub fn check_rate(&self, what: &str, dt: f64) -> Result<(), EnsembleError> {
        let network = self.description.dt;
        if network >= dt * (1.0 - RATE_TOLERANCE) {
            return Ok(());
        }
        Err(EnsembleError::TooFast { what: what.to_owned(), network_hz: 1.0 / network, hz: 1.0 / dt })
    }

    /// Predicts the torque of each row with each member, `[sequence][row][member]`, from states of zero.
    ///
    /// As in training, the burn-in rows have no prediction: the first is of row [`Ensemble::WARM_UP`], unless the
    /// sequence begins after a reset.
    pub fn predict<'a>(&self, runs: impl Iterator<Item = &'a Sequence> + Clone) -> Vec<Vec<Vec<Gaussian>>> {
        let windows = SequenceDataset::whole(runs.clone(), &self.description);
        let mut found: Vec<Vec<Vec<Gaussian>>> = runs.map(|_| Vec::new()).collect();
        let (device, scale) = (Device::flex(), self.description.scales.torque);
        let variance_scale = self.description.variance_scale * scale.std * scale.std;
        let networks: Vec<_> =
            self.members.iter().map(|weights| Network::new(self.description.shape(), weights, &device)).collect();
        let order: Vec<usize> = (0..windows.len()).collect();
        for indices in order.chunks(PREDICTION_BATCH) {
            let batch = windows.batch(indices);
            let outputs: Vec<[Vec<f32>; 2]> = networks.iter().map(|network| network.outputs(&batch)).collect();
            for (column, window) in indices.iter().enumerate() {
                for (time, run) in (0..batch.steps).filter_map(|time| Some((time, windows.place(*window, time)?.0))) {
                    let index = time * batch.size + column;
                    let gaussian = |[mean, variance]: &[Vec<f32>; 2]| Gaussian {
                        mean: scale.mean + scale.std * f64::from(mean[index]),
                        variance: variance_scale * f64::from(variance[index]),
                    };
                    found[run].push(outputs.iter().map(gaussian).collect());
                }
            }
        }
        found
    }

    /// Number of burn-in rows before the first prediction of a sequence that does not begin after a reset.
    pub const WARM_UP: usize = BURN_IN_ROWS;
}
