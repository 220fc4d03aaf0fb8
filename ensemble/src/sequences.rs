//! Slices of equal length from sequences, and batches of them.

use burn::tensor::TensorData;

use crate::data::Sequence;
use crate::metadata::EnsembleMetadata;

/// Number of rows of a training slice: a third of a second at 200 Hz, ten times the time constant of an actuator.
pub const SEQUENCE_ROWS: usize = 64;
/// Number of burn-in rows, which are inputs of the encoder but do not count in the loss.
pub const BURN_IN_ROWS: usize = 14;

/// Normalised sequences, cut into slices.
pub struct SequenceDataset {
    inputs: usize,
    /// Number of rows of a slice.
    time: usize,
    runs: Vec<NormalisedRun>,
    windows: Vec<SequenceSlice>,
}

struct NormalisedRun {
    /// Normalised input of each row.
    inputs: Vec<[f32; 2]>,
    torques: Vec<f32>,
    /// Index of the one-hot input of the joint.
    one_hot: Option<usize>,
}

/// A slice of a sequence from row `start`. Rows from `first_counted` on count in the loss.
struct SequenceSlice {
    run: usize,
    start: usize,
    first_counted: usize,
}

/// A batch of slices, ordered by time. Rows beyond the end of a sequence are zero and do not count.
pub struct Batch {
    /// Number of slices.
    pub size: usize,
    /// Number of rows of a slice.
    pub steps: usize,
    /// Number of inputs.
    inputs: usize,
    /// Inputs, `[time, batch, inputs]`.
    data: Vec<f32>,
    /// Normalised torques, `[time, batch]`.
    pub torques: Vec<f32>,
    /// 1 for rows that count in the loss, else 0, `[time, batch]`.
    pub mask: Vec<f32>,
}

impl SequenceDataset {
    /// Cuts sequences into training slices, in which every row counts once, except the first burn-in rows.
    pub fn sequences<'a>(runs: impl Iterator<Item = &'a Sequence>, model: &EnsembleMetadata) -> Self {
        Self::new(runs, model, SEQUENCE_ROWS)
    }

    /// Makes one slice of each sequence.
    pub fn whole<'a>(runs: impl Iterator<Item = &'a Sequence> + Clone, model: &EnsembleMetadata) -> Self {
        let longest = runs.clone().map(|run| run.torques.len()).max().unwrap_or(1);
        Self::new(runs, model, longest)
    }

    fn new<'a>(runs: impl Iterator<Item = &'a Sequence>, model: &EnsembleMetadata, time: usize) -> Self {
        let scales = &model.scales;
        let mut all = Self { inputs: model.shape().inputs, time, runs: Vec::new(), windows: Vec::new() };
        for (index, run) in runs.enumerate() {
            let normalised = |input: &[f64; 2]| std::array::from_fn(|i| scales.inputs[i].normalise(input[i]));
            all.runs.push(NormalisedRun {
                inputs: run.inputs.iter().map(normalised).collect(),
                torques: run.torques.iter().map(|torque| scales.torque.normalise(*torque)).collect(),
                one_hot: model.one_hot(run.joint),
            });
            let rows = run.torques.len();
            let mut counted = if run.after_reset { 0 } else { BURN_IN_ROWS };
            while counted < rows {
                let start = counted.saturating_sub(BURN_IN_ROWS);
                all.windows.push(SequenceSlice { run: index, start, first_counted: counted });
                counted = start + time;
            }
        }
        all
    }

    /// Returns the number of slices.
    pub fn len(&self) -> usize {
        self.windows.len()
    }

    /// Returns a batch of the slices with these indices.
    pub fn batch(&self, chosen: &[usize]) -> Batch {
        let (size, time, inputs) = (chosen.len(), self.time, self.inputs);
        let mut batch = Batch {
            size,
            steps: time,
            inputs,
            data: vec![0.0; time * size * inputs],
            torques: vec![0.0; time * size],
            mask: vec![0.0; time * size],
        };
        for (column, window) in chosen.iter().map(|index| &self.windows[*index]).enumerate() {
            let run = &self.runs[window.run];
            for row in window.start..run.torques.len().min(window.start + time) {
                let place = (row - window.start) * size + column;
                let input = &mut batch.data[place * inputs..(place + 1) * inputs];
                input[..2].copy_from_slice(&run.inputs[row]);
                if let Some(joint) = run.one_hot {
                    input[2 + joint] = 1.0;
                }
                batch.torques[place] = run.torques[row];
                batch.mask[place] = f32::from(u8::from(row >= window.first_counted));
            }
        }
        batch
    }

    /// Returns sequence and row of the row `time` of a slice, or `None` if it does not count.
    pub fn place(&self, window: usize, time: usize) -> Option<(usize, usize)> {
        let SequenceSlice { run, start, first_counted: counted } = self.windows[window];
        let row = start + time;
        (row >= counted && row < self.runs[run].torques.len()).then_some((run, row))
    }
}

impl Batch {
    /// Returns the number of rows that count.
    pub fn counted(&self) -> f64 {
        self.mask.iter().map(|count| f64::from(*count)).sum()
    }

    /// Returns the inputs of every row, `[time · batch, inputs]`.
    pub fn inputs(&self) -> TensorData {
        TensorData::new(self.data.clone(), [self.steps * self.size, self.inputs])
    }
}
