//! The training of one member.

use burn::module::Module;
use burn::optim::ModuleOptimizer;
use burn::tensor::{Bytes, Device};
use rand::seq::SliceRandom;
use twinstep_model::stream;

use crate::EnsembleError;
use crate::adam::adam;
use crate::checkpoint::MemberState;
use crate::network::Network;
use crate::train::{Epoch, TrainingOptions};
use crate::weights::{Shape, Weights};
use crate::windows::SequenceDataset;

/// Most sequences of a batch, and of a part of the validation.
const LARGEST_BATCH: usize = 256;
/// Least sequences of a batch; small data sets have at least [`STEPS`] batches an epoch down to this.
const SMALLEST_BATCH: usize = 16;
const STEPS: usize = 20;
/// Adam's first learning rate.
const LEARNING_RATE: f64 = 5e-3;
/// What the rate is multiplied by after [`PATIENCE`] epochs without a better validation.
const LR_DECAY: f64 = 0.3;
const PATIENCE: usize = 4;
/// The cut that ends the training instead.
const MAX_LR_DECAYS: i32 = 4;
/// A better validation is better by this [nat].
const MIN_DELTA: f64 = 1e-3;
/// Gradients of an array are no longer than this.
const MAX_GRAD_NORM: f32 = 1.0;
/// What a saved optimiser is of that burn cannot read.
const VERSION: &str = "versions of this program";

/// How a pass over the data ended.
pub enum EpochEnd {
    /// At its end.
    Done,
    /// The caller stopped it; what was learnt since the last end is to be forgotten.
    Stopped,
}

/// A member in training.
pub struct MemberTrainer<'a> {
    index: usize,
    options: &'a TrainingOptions,
    shape: Shape,
    network: Network,
    optimizer: ModuleOptimizer,
    best: Weights,
    curve: Vec<Epoch>,
}

impl<'a> MemberTrainer<'a> {
    /// From where `state` left off, on any device.
    pub fn new(
        index: usize,
        options: &'a TrainingOptions,
        shape: Shape,
        state: MemberState,
        device: &Device,
    ) -> Result<Self, EnsembleError> {
        let optimizer = match state.optimizer {
            saved if saved.is_empty() => adam(MAX_GRAD_NORM),
            saved => adam(MAX_GRAD_NORM)
                .from_bytes(Bytes::from_bytes_vec(saved))
                .map_err(|_| EnsembleError::OtherTraining { what: VERSION })?,
        };
        let network = Network::new(shape, &state.weights, &device.clone().autodiff());
        Ok(Self { index, options, shape, network, optimizer, best: state.best, curve: state.curve })
    }

    /// Learns from every sequence once, in an order of its own. `each` hears of every batch how many sequences it had, and
    /// stops the epoch when it answers `false`.
    pub fn epoch(
        &mut self,
        sequences: &SequenceDataset,
        validation: &SequenceDataset,
        each: &mut dyn FnMut(usize) -> bool,
    ) -> Result<EpochEnd, EnsembleError> {
        let rate = schedule(&self.curve).unwrap_or(LEARNING_RATE);
        let mut order: Vec<usize> = (0..sequences.len()).collect();
        let name = format!("order of member {}", self.index);
        order.shuffle(&mut stream(self.options.seed, &name, self.curve.len() as u64));
        let size = (order.len() / STEPS).clamp(SMALLEST_BATCH, LARGEST_BATCH);
        let (mut sum, mut count) = (0.0, 0.0);
        for chosen in order.chunks(size) {
            let batch = sequences.batch(chosen);
            let (nll, gradients) = self.network.loss_and_gradients(&batch);
            self.network = self.optimizer.step(rate, self.network.clone(), gradients);
            sum += f64::from(nll) * batch.counted();
            count += batch.counted();
            if !each(chosen.len()) {
                return Ok(EpochEnd::Stopped);
            }
        }
        let epoch = Epoch { training_nll: sum / count, validation_nll: self.nll(validation) };
        if !(epoch.training_nll.is_finite() && epoch.validation_nll.is_finite()) {
            return Err(EnsembleError::Diverged { member: self.index, epoch: self.curve.len() + 1, rate });
        }
        let best = self.curve.iter().map(|epoch| epoch.validation_nll).fold(f64::INFINITY, f64::min);
        if epoch.validation_nll < best {
            self.best = self.network.weights(self.shape);
        }
        self.curve.push(epoch);
        Ok(EpochEnd::Done)
    }

    /// Where it stands at an epoch's end.
    pub fn state(&self) -> Result<MemberState, EnsembleError> {
        let optimizer = self.optimizer.into_bytes().map_err(|_| EnsembleError::OtherTraining { what: VERSION })?;
        Ok(MemberState {
            weights: self.network.weights(self.shape),
            best: self.best.clone(),
            optimizer: optimizer.to_vec(),
            curve: self.curve.clone(),
        })
    }

    /// Mean negative log-likelihood over `windows`.
    fn nll(&self, windows: &SequenceDataset) -> f64 {
        let network = self.network.valid();
        let order: Vec<usize> = (0..windows.len()).collect();
        let (mut sum, mut count) = (0.0, 0.0);
        for chosen in order.chunks(LARGEST_BATCH) {
            let batch = windows.batch(chosen);
            sum += f64::from(network.nll(&batch)) * batch.counted();
            count += batch.counted();
        }
        sum / count
    }
}

/// Whether the training of a member with this `curve` is over.
pub fn finished(curve: &[Epoch], options: &TrainingOptions) -> bool {
    curve.len() >= options.epochs || schedule(curve).is_none()
}

/// The learning rate after the epochs of `curve`; none when it is time to end.
fn schedule(curve: &[Epoch]) -> Option<f64> {
    let (mut best, mut stale, mut cuts) = (f64::INFINITY, 0, 0);
    for epoch in curve {
        stale = if epoch.validation_nll < best - MIN_DELTA { 0 } else { stale + 1 };
        best = best.min(epoch.validation_nll);
        if stale == PATIENCE {
            (stale, cuts) = (0, cuts + 1);
        }
    }
    (cuts < MAX_LR_DECAYS).then(|| LEARNING_RATE * LR_DECAY.powi(cuts))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(nlls: &[f64]) -> Option<f64> {
        schedule(&nlls.iter().map(|nll| Epoch { training_nll: *nll, validation_nll: *nll }).collect::<Vec<_>>())
    }

    #[test]
    fn rate_falls_when_validation_stays_and_the_fourth_time_training_ends() {
        assert_eq!(rate(&[3.0, 2.0, 1.0, 0.0, -1.0]), Some(LEARNING_RATE));
        assert_eq!(rate(&[1.0, 2.0, 2.0, 2.0, 2.0]), Some(LEARNING_RATE * LR_DECAY));
        assert_eq!(rate(&[1.0, 2.0, 2.0, 2.0, 0.0, 2.0]), Some(LEARNING_RATE));
        assert_eq!(rate(&[1.0; 17]), None);
    }
}
