//! Runs cut into sequences of one length, and batches of them.

use burn::tensor::TensorData;

use crate::data::Sequence;
use crate::ensemble::EnsembleMetadata;

/// Rows of a sequence in training: a third of a second at 200 Hz, ten times a drive's memory.
pub const SEQUENCE_ROWS: usize = 64;
/// Rows after an unseen past: the encoder hears them, but they do not count.
pub const BURN_IN_ROWS: usize = 14;

/// Sequences of normalised rows.
pub struct SequenceDataset {
    inputs: usize,
    /// Rows of a sequence.
    time: usize,
    runs: Vec<NormalisedRun>,
    windows: Vec<SequenceSlice>,
}

struct NormalisedRun {
    /// ξ of each row.
    errors: Vec<[f32; 2]>,
    torques: Vec<f32>,
    /// The input that is 1 for this run's joint.
    one_hot: Option<usize>,
}

/// A sequence: rows of a run from `start`, of which those from `counted` on count.
struct SequenceSlice {
    run: usize,
    start: usize,
    first_counted: usize,
}

/// Sequences side by side, time by time; rows beyond a run's end are zero, and do not count.
pub struct Batch {
    /// Sequences.
    pub size: usize,
    /// Rows of a sequence.
    pub steps: usize,
    /// Entries of an input.
    inputs: usize,
    /// `[time, batch, inputs]`.
    data: Vec<f32>,
    /// `[time, batch]`.
    pub torques: Vec<f32>,
    /// One where a row counts, `[time, batch]`.
    pub mask: Vec<f32>,
}

impl SequenceDataset {
    /// Training sequences of `runs`, in which every row counts once unless its past is unseen.
    pub fn sequences<'a>(runs: impl Iterator<Item = &'a Sequence>, model: &EnsembleMetadata) -> Self {
        Self::new(runs, model, SEQUENCE_ROWS)
    }

    /// `runs` as they are, each one sequence.
    pub fn whole<'a>(runs: impl Iterator<Item = &'a Sequence> + Clone, model: &EnsembleMetadata) -> Self {
        let longest = runs.clone().map(|run| run.torques.len()).max().unwrap_or(1);
        Self::new(runs, model, longest)
    }

    fn new<'a>(runs: impl Iterator<Item = &'a Sequence>, model: &EnsembleMetadata, time: usize) -> Self {
        let scales = &model.scales;
        let mut all = Self { inputs: model.shape().inputs, time, runs: Vec::new(), windows: Vec::new() };
        for (index, run) in runs.enumerate() {
            let normalised = |error: &[f64; 2]| std::array::from_fn(|i| scales.errors[i].normalise(error[i]));
            all.runs.push(NormalisedRun {
                errors: run.errors.iter().map(normalised).collect(),
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

    /// How many sequences there are.
    pub fn len(&self) -> usize {
        self.windows.len()
    }

    /// The sequences `chosen`, side by side.
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
                input[..2].copy_from_slice(&run.errors[row]);
                if let Some(joint) = run.one_hot {
                    input[2 + joint] = 1.0;
                }
                batch.torques[place] = run.torques[row];
                batch.mask[place] = f32::from(u8::from(row >= window.first_counted));
            }
        }
        batch
    }

    /// The run of a sequence, and the row of that run which `time` in the sequence is, if it counts.
    pub fn place(&self, window: usize, time: usize) -> Option<(usize, usize)> {
        let SequenceSlice { run, start, first_counted: counted } = self.windows[window];
        let row = start + time;
        (row >= counted && row < self.runs[run].torques.len()).then_some((run, row))
    }
}

impl Batch {
    /// How many rows count.
    pub fn counted(&self) -> f64 {
        self.mask.iter().map(|count| f64::from(*count)).sum()
    }

    /// Inputs of every row, `[time · batch, inputs]`.
    pub fn inputs(&self) -> TensorData {
        TensorData::new(self.data.clone(), [self.steps * self.size, self.inputs])
    }
}
