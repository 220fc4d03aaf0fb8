//! Training of one member.

use burn::module::Module;
use burn::optim::ModuleOptimizer;
use burn::tensor::{Bytes, Device};
use rand::seq::SliceRandom;
use twinstep_model::stream;

use crate::EnsembleError;
use crate::adam::adam;
use crate::checkpoint::{Epoch, MemberState};
use crate::network::Network;
use crate::sequences::SequenceDataset;
use crate::training_options::TrainingOptions;
use crate::weights::{Shape, Weights};

/// Maximum number of sequences in a batch.
const LARGEST_BATCH: usize = 256;
/// Minimum number of sequences in a batch.
const SMALLEST_BATCH: usize = 16;
/// Number of batches per epoch, as far as the limits of the batch size allow.
const STEPS: usize = 20;
/// Initial learning rate of Adam.
const LEARNING_RATE: f64 = 5e-3;
/// Factor by which the learning rate decays after [`PATIENCE`] epochs without a better validation loss.
const LR_DECAY: f64 = 0.3;
/// Number of epochs without a better validation loss before a decay.
const PATIENCE: usize = 4;
/// Number of decays at which the training ends.
const MAX_LR_DECAYS: i32 = 4;
/// Minimum decrease of the validation loss that counts as better [nat].
const MIN_DELTA: f64 = 1e-3;
/// Maximum norm of the gradient of each array.
const MAX_GRAD_NORM: f32 = 1.0;
/// What differs if burn cannot load a saved optimiser.
const VERSION: &str = "program versions";

/// How an epoch ended.
pub enum EpochEnd {
    /// All sequences were used.
    Done,
    /// The caller stopped it. The updates of this epoch must be discarded.
    Stopped,
}

/// Trains one member.
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
    /// Resumes a training from `state` on any device.
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

    /// Trains for one epoch: every sequence once, in an order that depends on the member.
    ///
    /// `each` is called after every batch with its number of sequences, and stops the epoch by returning `false`.
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

    /// Returns the state at the end of an epoch.
    pub fn state(&self) -> Result<MemberState, EnsembleError> {
        let optimizer = self.optimizer.into_bytes().map_err(|_| EnsembleError::OtherTraining { what: VERSION })?;
        Ok(MemberState {
            weights: self.network.weights(self.shape),
            best: self.best.clone(),
            optimizer: optimizer.to_vec(),
            curve: self.curve.clone(),
        })
    }

    /// Returns the mean negative log-likelihood of `windows` [nat].
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

/// Returns true if the training of a member with this `curve` is finished.
pub fn finished(curve: &[Epoch], options: &TrainingOptions) -> bool {
    curve.len() >= options.epochs || schedule(curve).is_none()
}

/// Returns the learning rate after the epochs of `curve`, or `None` if the training ends.
fn schedule(curve: &[Epoch]) -> Option<f64> {
    let (mut best, mut stale, mut decays) = (f64::INFINITY, 0, 0);
    for epoch in curve {
        stale = if epoch.validation_nll < best - MIN_DELTA { 0 } else { stale + 1 };
        best = best.min(epoch.validation_nll);
        if stale == PATIENCE {
            (stale, decays) = (0, decays + 1);
        }
    }
    (decays < MAX_LR_DECAYS).then(|| LEARNING_RATE * LR_DECAY.powi(decays))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(nlls: &[f64]) -> Option<f64> {
        schedule(&nlls.iter().map(|nll| Epoch { training_nll: *nll, validation_nll: *nll }).collect::<Vec<_>>())
    }

    #[test]
    fn rate_decays_without_a_better_validation_loss_and_the_fourth_time_training_ends() {
        assert_eq!(rate(&[3.0, 2.0, 1.0, 0.0, -1.0]), Some(LEARNING_RATE));
        assert_eq!(rate(&[1.0, 2.0, 2.0, 2.0, 2.0]), Some(LEARNING_RATE * LR_DECAY));
        assert_eq!(rate(&[1.0, 2.0, 2.0, 2.0, 0.0, 2.0]), Some(LEARNING_RATE));
        assert_eq!(rate(&[1.0; 17]), None);
    }
}
