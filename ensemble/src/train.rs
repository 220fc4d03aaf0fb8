//! Training: every member on its own, as many at once as there are threads.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use crate::EnsembleError;
use crate::calibration::variance_scale;
use crate::checkpoint::{Checkpoint, MemberState};
use crate::data::{Split, DataSet};
use crate::ensemble::{EnsembleMetadata, Ensemble, JointEncoding};
use crate::gpu;
use crate::member::{EpochEnd, MemberTrainer, finished};
use crate::scales::Normalisers;
use crate::windows::SequenceDataset;

/// How often the caller is asked whether to go on.
const TICK: Duration = Duration::from_millis(100);

/// How an ensemble is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingOptions {
    /// Number of networks.
    pub members: usize,
    /// Units of each encoder.
    pub hidden: usize,
    /// What a network is told of the joint.
    pub joint_input: JointEncoding,
    /// Most passes over the data.
    pub epochs: usize,
    /// Seed of first weights and order of data: equal seeds give equal ensembles, whatever the number of threads.
    pub seed: u64,
}

impl Default for TrainingOptions {
    /// Six members as in U2E.
    fn default() -> Self {
        Self { members: 6, hidden: 32, joint_input: JointEncoding::Pooled, epochs: 100, seed: 0 }
    }
}

impl TrainingOptions {
    fn check(&self) -> Result<(), EnsembleError> {
        for (option, given, most) in
            [("members", self.members, 100), ("hidden", self.hidden, 512), ("epochs", self.epochs, 100_000)]
        {
            if !(1..=most).contains(&given) {
                return Err(EnsembleError::Option { option, given, most });
            }
        }
        Ok(())
    }
}

/// A pass over the data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Mean negative log-likelihood of the training rows while they were learnt from [nat, of torque in N·m].
    pub training_nll: f64,
    /// That of the validation rows after it.
    pub validation_nll: f64,
}

/// How far a training is.
pub enum TrainingEvent<'a> {
    /// Sequences that members have learnt from since the last time.
    Sequences(usize),
    /// A member has ended an epoch, which is the last of its `curve`.
    Epoch {
        /// Index of the member.
        member: usize,
        /// Whether it was the member's last.
        done: bool,
        /// All its epochs so far.
        curve: &'a [Epoch],
        /// From here the training can go on later.
        checkpoint: &'a Checkpoint,
    },
    /// A tenth of a second has passed without news.
    Tick,
}

/// How a training ended.
#[derive(Debug)]
pub enum TrainingResult {
    /// All members are trained; the epochs of each.
    Trained(Box<Ensemble>, Vec<Vec<Epoch>>),
    /// The caller ended it; from here it can go on.
    Interrupted(Checkpoint),
}

/// Data and settings of a training.
pub struct Training<'a> {
    data: &'a DataSet,
    options: TrainingOptions,
    /// Of the ensemble, before variances are scaled.
    pub(crate) description: EnsembleMetadata,
    sequences: SequenceDataset,
    validation: SequenceDataset,
    device: Device,
}

/// News from a thread.
enum WorkerMessage {
    Sequences(usize),
    Epoch(usize, Box<MemberState>),
    Failed(EnsembleError),
}

impl<'a> Training<'a> {
    /// Fails if a setting is out of range.
    pub fn new(data: &'a DataSet, options: TrainingOptions) -> Result<Self, EnsembleError> {
        options.check()?;
        let description = EnsembleMetadata {
            members: options.members,
            hidden: options.hidden,
            dt: data.dt,
            joints: data.joints.clone(),
            joint_input: options.joint_input,
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
        Ok(Self { data, options, description, sequences, validation, device: Device::flex() })
    }

    /// Trains on the best GPU there is, whose name it gives, in place of the CPU.
    ///
    /// Numbers differ by rounding; a checkpoint goes on on either. Needs the feature `gpu`.
    pub fn on_gpu(&mut self) -> Result<&'static str, EnsembleError> {
        let (device, name) = gpu::best()?;
        self.device = device;
        Ok(name)
    }

    /// Sequences that a member learns from in an epoch.
    pub fn sequences_an_epoch(&self) -> usize {
        self.sequences.len()
    }

    /// Trains all members on `threads` threads (on a GPU one after another), from `resume` on where there is one.
    ///
    /// `progress` is called ten times a second and more, in the caller's thread, and ends the training when it answers `false`.
    pub fn run(
        &self,
        threads: usize,
        resume: Option<Checkpoint>,
        progress: &mut dyn FnMut(TrainingEvent) -> bool,
    ) -> Result<TrainingResult, EnsembleError> {
        let mut checkpoint = match resume {
            Some(saved) => saved.of(&self.options, &self.description.data_hash)?,
            None => Checkpoint::new(self.options.clone(), &self.description),
        };
        let done = |member: &MemberState| finished(&member.curve, &self.options);
        let all = checkpoint.members.iter().cloned().enumerate();
        let waiting: VecDeque<_> = all.filter(|(_, member)| !done(member)).collect();
        let (waiting, stop) = (Mutex::new(waiting), AtomicBool::new(false));
        let most = if self.device == Device::flex() { self.options.members } else { 1 };
        std::thread::scope(|scope| {
            let (sender, news) = channel();
            for _ in 0..threads.clamp(1, most) {
                let sender = sender.clone();
                let (waiting, stop) = (&waiting, &stop);
                scope.spawn(move || self.work(waiting, stop, sender));
            }
            drop(sender);
            let mut failure = None;
            loop {
                let go_on = match news.recv_timeout(TICK) {
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
                if !go_on {
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

    /// Trains one waiting member after another.
    fn work(&self, waiting: &Mutex<VecDeque<(usize, MemberState)>>, stop: &AtomicBool, sender: Sender<WorkerMessage>) {
        let next = || waiting.lock().ok()?.pop_front().filter(|_| !stop.load(Ordering::Relaxed));
        // Nobody listens once the caller's thread has panicked.
        let tell = |news| sender.send(news).is_ok();
        while let Some((index, state)) = next() {
            let trained = self.member(index, state, stop, &tell);
            if let Err(error) = trained {
                tell(WorkerMessage::Failed(error));
                return;
            }
        }
    }

    /// Trains a member to its end, or until `stop`.
    fn member(
        &self,
        index: usize,
        state: MemberState,
        stop: &AtomicBool,
        tell: &dyn Fn(WorkerMessage) -> bool,
    ) -> Result<(), EnsembleError> {
        let mut member = MemberTrainer::new(index, &self.options, self.description.shape(), state, &self.device)?;
        let mut each = |sequences| tell(WorkerMessage::Sequences(sequences)) && !stop.load(Ordering::Relaxed);
        while let EpochEnd::Done = member.epoch(&self.sequences, &self.validation, &mut each)? {
            let state = member.state()?;
            let done = finished(&state.curve, &self.options);
            if !tell(WorkerMessage::Epoch(index, Box::new(state))) || done {
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

    fn data() -> DataSet {
        DataSet::new(&[("here".to_owned(), log(4000, |_, _| {}))]).expect("a set")
    }

    fn options(epochs: usize) -> TrainingOptions {
        TrainingOptions { members: 2, hidden: 8, epochs, seed: 1, ..TrainingOptions::default() }
    }

    fn trained(outcome: TrainingResult) -> (Ensemble, Vec<Vec<Epoch>>) {
        match outcome {
            TrainingResult::Trained(ensemble, curves) => (*ensemble, curves),
            TrainingResult::Interrupted(_) => panic!("it had no reason to end"),
        }
    }

    #[test]
    fn ensemble_learns_a_late_drive_to_its_noise_and_knows_how_large_that_is() {
        let data = data();
        let (ensemble, curves) =
            trained(Training::new(&data, options(60)).and_then(|t| t.run(2, None, &mut |_| true)).expect("trains"));
        let found = Calibration::of(&ensemble, &data);
        assert!(found.rmse < 1.3 * NOISE, "{} N·m", found.rmse);
        let [_, ninety, _] = found.mixture[1].empirical;
        assert!((0.85..=0.95).contains(&ninety), "{ninety} of the truth in the 90 % interval");
        assert!((0.8..1.3).contains(&(found.sharpness / NOISE)), "{} N·m", found.sharpness);
        assert!(curves.iter().all(|curve| curve[curve.len() - 1].validation_nll < curve[0].validation_nll));
    }

    #[test]
    fn training_goes_on_from_a_file_to_the_same_bits_on_any_number_of_threads() {
        let (data, folder) = (data(), tempfile::tempdir().expect("a folder"));
        let training = Training::new(&data, options(4)).expect("options");
        let whole = trained(training.run(1, None, &mut |_| true).expect("trains"));
        let mut epochs = 0;
        let ended = training.run(2, None, &mut |progress| {
            epochs += usize::from(matches!(progress, TrainingEvent::Epoch { .. }));
            epochs < 3
        });
        let Ok(TrainingResult::Interrupted(checkpoint)) = ended else { panic!("it was told to end") };
        let path = folder.path().join("training");
        checkpoint.write(&path).expect("written");
        let read = || Checkpoint::read(&path).expect("read");
        assert_eq!(trained(training.run(2, Some(read()), &mut |_| true).expect("trains")), whole);

        let other = |options| {
            let training = Training::new(&data, options).expect("options");
            training.run(1, Some(read()), &mut |_| true).expect_err("refused").to_string()
        };
        assert!(other(TrainingOptions { seed: 2, ..options(4) }).contains("other settings"));
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn gpu_learns_what_the_cpu_learns_and_each_goes_on_where_the_other_ended() {
        if gpu::tests::device().is_none() {
            return;
        }
        let data = data();
        let training = || Training::new(&data, options(2)).expect("options");
        let (on_cpu, mut on_gpu) = (training(), training());
        on_gpu.on_gpu().expect("a GPU");
        let curves = |training: &Training, resume| trained(training.run(2, resume, &mut |_| true).expect("trains")).1;
        let wanted = curves(&on_cpu, None);
        let close = |found: Vec<Vec<Epoch>>| {
            for (found, wanted) in found.iter().flatten().zip(wanted.iter().flatten()) {
                let apart = (found.validation_nll - wanted.validation_nll).abs();
                assert!(apart < 1e-3, "{found:?} for {wanted:?}");
                println!("{apart:e} nat");
            }
        };
        close(curves(&on_gpu, None));
        for [first, second] in [[&on_cpu, &on_gpu], [&on_gpu, &on_cpu]] {
            let ended = first.run(1, None, &mut |progress| !matches!(progress, Progress::Epoch { .. }));
            let Ok(TrainingResult::Interrupted(checkpoint)) = ended else { panic!("it was told to end") };
            close(curves(second, Some(checkpoint)));
        }
    }

    #[test]
    fn network_that_is_told_the_joint_learns_drives_that_differ() {
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
        let [pooled, told] = [JointEncoding::Pooled, JointEncoding::Identity].map(rmse);
        assert!(told < 0.5 * pooled, "{told} N·m, pooled {pooled} N·m");
        let of_a_kind = Training::new(&data, TrainingOptions { joint_input: JointEncoding::Kind, ..options(15) });
        let error = of_a_kind.map(|_| ()).expect_err("refused").to_string();
        assert!(error.starts_with("joint `knee` is no hip, thigh or calf of a Go2"), "{error}");
    }

    #[test]
    fn setting_out_of_range_is_named() {
        let error = Training::new(&data(), TrainingOptions { members: 0, ..options(4) }).map(|_| ()).expect_err("refused");
        assert_eq!(error.to_string(), "`members` = 0 is outside 1..=100");
    }
}
