//! Training: the members are independent, and one thread trains one member at a time.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use burn::tensor::Device;

use crate::EnsembleError;
use crate::calibration::variance_scale;
use crate::checkpoint::{Checkpoint, Epoch, MemberState};
use crate::data::{DataSet, Split};
use crate::ensemble::Ensemble;
use crate::gpu;
use crate::member::{EpochEnd, MemberTrainer, finished};
use crate::metadata::EnsembleMetadata;
use crate::normaliser::Normalisers;
use crate::sequences::SequenceDataset;
use crate::training_options::TrainingOptions;
use crate::warm_start::initial_weights;
use crate::weights::Weights;

/// Maximum time between two calls of `progress`.
const TICK: Duration = Duration::from_millis(100);

/// Progress of a training.
pub enum TrainingEvent<'a> {
    /// Number of sequences that were processed since the last event.
    Sequences(usize),
    /// A member has completed an epoch, the last of its `curve`.
    Epoch {
        /// Index of the member.
        member: usize,
        /// True if the training of the member is finished.
        done: bool,
        /// All epochs of the member so far.
        curve: &'a [Epoch],
        /// State from which the training can be resumed.
        checkpoint: &'a Checkpoint,
    },
    /// 0.1 s have passed without another event.
    Tick,
}

/// Result of a training.
#[derive(Debug)]
pub enum TrainingResult {
    /// The trained ensemble, and the epochs of each member.
    Trained(Box<Ensemble>, Vec<Vec<Epoch>>),
    /// The caller interrupted the training, which can be resumed from this state.
    Interrupted(Checkpoint),
}

/// Data and options of a training.
pub struct Training<'a> {
    data: &'a DataSet,
    options: TrainingOptions,
    /// Metadata of the ensemble before the calibration of the variances.
    pub(crate) description: EnsembleMetadata,
    sequences: SequenceDataset,
    validation: SequenceDataset,
    /// Initial weights of each member; `None` if they are sampled.
    initial: Option<Vec<Weights>>,
    device: Device,
}

/// Message from a worker thread.
enum WorkerMessage {
    Sequences(usize),
    Epoch(usize, Box<MemberState>),
    Failed(EnsembleError),
}

impl<'a> Training<'a> {
    /// Prepares a training. Fails if an option is out of range.
    pub fn new(data: &'a DataSet, options: TrainingOptions) -> Result<Self, EnsembleError> {
        options.check()?;
        let description = EnsembleMetadata {
            members: options.members,
            hidden: options.hidden,
            dt: data.dt,
            joints: data.joints.clone(),
            joint_input: options.joint_input,
            input: data.input,
            target: data.target,
            scales: Normalisers::of(data),
            tau_sensor: data.tau_sensor,
            gains: data.gains.clone(),
            variance_scale: 1.0,
            data_hash: data.hash(),
            seed: options.seed,
        };
        description.check()?;
        let sequences = SequenceDataset::sequences(data.runs(Split::Training), &description);
        let validation = SequenceDataset::sequences(data.runs(Split::Validation), &description);
        Ok(Self { data, options, description, sequences, validation, initial: None, device: Device::flex() })
    }

    /// Starts each member with the weights of a member of `earlier` instead of sampled ones.
    ///
    /// The normalisation is that of the new data; the weights are converted to it.
    pub fn warm_start(&mut self, earlier: &Ensemble) -> Result<(), EnsembleError> {
        self.initial = Some(initial_weights(earlier, &self.description)?);
        Ok(())
    }

    /// Selects the best GPU for training instead of the CPU, and returns its name.
    ///
    /// Results differ by rounding. A checkpoint can be resumed on either. Requires the feature `gpu`.
    pub fn on_gpu(&mut self) -> Result<&'static str, EnsembleError> {
        let (device, name) = gpu::best()?;
        self.device = device;
        Ok(name)
    }

    /// Returns the number of sequences per epoch of a member.
    pub fn sequences_an_epoch(&self) -> usize {
        self.sequences.len()
    }

    /// Trains all members on `threads` threads, or resumes from a checkpoint. On a GPU they are trained in turn.
    ///
    /// `progress` is called at least ten times per second on the caller's thread. It interrupts the training by
    /// returning `false`.
    pub fn run(
        &self,
        threads: usize,
        resume: Option<Checkpoint>,
        progress: &mut dyn FnMut(TrainingEvent) -> bool,
    ) -> Result<TrainingResult, EnsembleError> {
        let mut checkpoint = match resume {
            Some(saved) => saved.of(&self.options, &self.description.data_hash)?,
            None => Checkpoint::new(self.options.clone(), &self.description, self.initial.as_deref()),
        };
        let done = |member: &MemberState| finished(&member.curve, &self.options);
        let all = checkpoint.members.iter().cloned().enumerate();
        let queue: VecDeque<_> = all.filter(|(_, member)| !done(member)).collect();
        let (queue, stop) = (Mutex::new(queue), AtomicBool::new(false));
        let max = if self.device == Device::flex() { self.options.members } else { 1 };
        std::thread::scope(|scope| {
            let (sender, messages) = channel();
            for _ in 0..threads.clamp(1, max) {
                let sender = sender.clone();
                let (queue, stop) = (&queue, &stop);
                scope.spawn(move || self.work(queue, stop, sender));
            }
            drop(sender);
            let mut failure = None;
            loop {
                let proceed = match messages.recv_timeout(TICK) {
                    Ok(WorkerMessage::Sequences(count)) => progress(TrainingEvent::Sequences(count)),
                    Ok(WorkerMessage::Epoch(member, state)) => {
                        checkpoint.members[member] = *state;
                        let state = &checkpoint.members[member];
                        let (done, curve) = (done(state), &state.curve);
                        progress(TrainingEvent::Epoch { member, done, curve, checkpoint: &checkpoint })
                    }
                    Ok(WorkerMessage::Failed(error)) => {
                        failure.get_or_insert(error);
                        false
                    }
                    Err(RecvTimeoutError::Timeout) => progress(TrainingEvent::Tick),
                    Err(RecvTimeoutError::Disconnected) => break,
                };
                if !proceed {
                    stop.store(true, Ordering::Relaxed);
                }
            }
            failure.map_or(Ok(()), Err)
        })?;
        if !checkpoint.members.iter().all(done) {
            return Ok(TrainingResult::Interrupted(checkpoint));
        }
        let (weights, curves) = checkpoint.members.into_iter().map(|member| (member.best, member.curve)).unzip();
        let mut ensemble = Ensemble { description: self.description.clone(), members: weights };
        ensemble.description.variance_scale = variance_scale(&ensemble, self.data);
        Ok(TrainingResult::Trained(Box::new(ensemble), curves))
    }

    /// Trains the members of the queue one after another.
    fn work(&self, queue: &Mutex<VecDeque<(usize, MemberState)>>, stop: &AtomicBool, sender: Sender<WorkerMessage>) {
        let next = || queue.lock().ok()?.pop_front().filter(|_| !stop.load(Ordering::Relaxed));
        // Sending fails if the caller's thread has panicked.
        let send = |message| sender.send(message).is_ok();
        while let Some((index, state)) = next() {
            let trained = self.member(index, state, stop, &send);
            if let Err(error) = trained {
                send(WorkerMessage::Failed(error));
                return;
            }
        }
    }

    /// Trains a member until it is finished, or until `stop`.
    fn member(
        &self,
        index: usize,
        state: MemberState,
        stop: &AtomicBool,
        send: &dyn Fn(WorkerMessage) -> bool,
    ) -> Result<(), EnsembleError> {
        let mut member = MemberTrainer::new(index, &self.options, self.description.shape(), state, &self.device)?;
        let mut each = |sequences| send(WorkerMessage::Sequences(sequences)) && !stop.load(Ordering::Relaxed);
        while let EpochEnd::Done = member.epoch(&self.sequences, &self.validation, &mut each)? {
            let state = member.state()?;
            let done = finished(&state.curve, &self.options);
            if !send(WorkerMessage::Epoch(index, Box::new(state))) || done {
                break;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use crate::data::tests::{NOISE, log};
    use crate::metadata::JointEncoding;

    fn data() -> DataSet {
        DataSet::new(&[("here".to_owned(), log(4000, |_, _| {}))]).expect("a set")
    }

    fn options(epochs: usize) -> TrainingOptions {
        TrainingOptions { members: 2, hidden: 8, epochs, seed: 1, ..TrainingOptions::default() }
    }

    fn trained(outcome: TrainingResult) -> (Ensemble, Vec<Vec<Epoch>>) {
        match outcome {
            TrainingResult::Trained(ensemble, curves) => (*ensemble, curves),
            TrainingResult::Interrupted(_) => panic!("the training was interrupted"),
        }
    }

    #[test]
    fn error_and_sharpness_of_a_delayed_actuator_are_close_to_the_noise() {
        let data = data();
        let (ensemble, curves) =
            trained(Training::new(&data, options(60)).and_then(|t| t.run(2, None, &mut |_| true)).expect("trains"));
        let found = Calibration::of(&ensemble, &data);
        assert!(found.rmse < 1.3 * NOISE, "{} N·m", found.rmse);
        let [_, ninety, _] = found.mixture[1].empirical;
        assert!((0.85..=0.95).contains(&ninety), "{ninety} of the rows are in the 90 % interval");
        assert!((0.8..1.3).contains(&(found.sharpness / NOISE)), "{} N·m", found.sharpness);
        assert!(curves.iter().all(|curve| curve[curve.len() - 1].validation_nll < curve[0].validation_nll));
    }

    #[test]
    fn resumed_training_is_bitwise_equal_on_any_number_of_threads() {
        let (data, folder) = (data(), tempfile::tempdir().expect("a folder"));
        let training = Training::new(&data, options(4)).expect("options");
        let whole = trained(training.run(1, None, &mut |_| true).expect("trains"));
        let mut epochs = 0;
        let ended = training.run(2, None, &mut |progress| {
            epochs += usize::from(matches!(progress, TrainingEvent::Epoch { .. }));
            epochs < 3
        });
        let Ok(TrainingResult::Interrupted(checkpoint)) = ended else { panic!("the training was not interrupted") };
        let path = folder.path().join("training");
        checkpoint.write(&path).expect("written");
        let read = || Checkpoint::read(&path).expect("read");
        assert_eq!(trained(training.run(2, Some(read()), &mut |_| true).expect("trains")), whole);

        let other = |options| {
            let training = Training::new(&data, options).expect("options");
            training.run(1, Some(read()), &mut |_| true).expect_err("rejected").to_string()
        };
        assert!(other(TrainingOptions { seed: 2, ..options(4) }).contains("different settings"));
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn training_on_a_gpu_agrees_with_the_cpu_and_each_resumes_the_other() {
        if gpu::tests::device().is_none() {
            return;
        }
        let data = data();
        let training = || Training::new(&data, options(2)).expect("options");
        let (on_cpu, mut on_gpu) = (training(), training());
        on_gpu.on_gpu().expect("a GPU");
        let curves = |training: &Training, resume| trained(training.run(2, resume, &mut |_| true).expect("trains")).1;
        let expected = curves(&on_cpu, None);
        let assert_close = |found: Vec<Vec<Epoch>>| {
            for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
                let difference = (found.validation_nll - expected.validation_nll).abs();
                assert!(difference < 1e-3, "{found:?} for {expected:?}");
                println!("{difference:e} nat");
            }
        };
        assert_close(curves(&on_gpu, None));
        for [first, second] in [[&on_cpu, &on_gpu], [&on_gpu, &on_cpu]] {
            let ended = first.run(1, None, &mut |progress| !matches!(progress, TrainingEvent::Epoch { .. }));
            let Ok(TrainingResult::Interrupted(checkpoint)) = ended else { panic!("the training was not interrupted") };
            assert_close(curves(second, Some(checkpoint)));
        }
    }

    #[test]
    fn joint_encoding_distinguishes_different_actuators() {
        let strong = log(4000, |_, columns| {
            let weak = |name: &str| {
                let (_, cells) = columns.iter().find(|(column, _)| column == name).expect("a column");
                (name.replace("knee", "ankle"), cells.clone())
            };
            let mut more = ["q_knee", "dq_knee", "q_cmd_knee", "tau_measured_knee"].map(weak);
            more[3].1.iter_mut().for_each(|torque| *torque *= 0.5);
            columns.extend(more);
        });
        let data = DataSet::new(&[("here".to_owned(), strong)]).expect("a set");
        let rmse = |joint_input| {
            let training = Training::new(&data, TrainingOptions { joint_input, ..options(15) }).expect("options");
            Calibration::of(&trained(training.run(2, None, &mut |_| true).expect("trains")).0, &data).rmse
        };
        let [pooled, encoded] = [JointEncoding::Pooled, JointEncoding::Identity].map(rmse);
        assert!(encoded < 0.5 * pooled, "{encoded} N·m, pooled {pooled} N·m");
        let with_joint_type = Training::new(&data, TrainingOptions { joint_input: JointEncoding::Kind, ..options(15) });
        let error = with_joint_type.map(|_| ()).expect_err("rejected").to_string();
        assert!(error.starts_with("joint `knee` is not a hip, thigh or calf of a Go2"), "{error}");
    }

    #[test]
    fn error_names_the_option_out_of_range() {
        let error =
            Training::new(&data(), TrainingOptions { members: 0, ..options(4) }).map(|_| ()).expect_err("rejected");
        assert_eq!(error.to_string(), "`members` = 0 is not allowed: 1 to 100");
    }
}
