//! Fit of an ensemble of actuator networks to measured logs.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use twinstep_ensemble::{
    Calibration, Checkpoint, DataOptions, DataSet, Ensemble, EnsembleError, Epoch, JointEncoding, NetworkInput,
    NetworkTarget, Training, TrainingEvent, TrainingOptions, TrainingResult as Ended,
};
use twinstep_identify::{residual_at_output, residual_at_sensor};
use twinstep_logs::{Log, ResampleError};
use twinstep_model::RobotModel;
use twinstep_report::chart;

use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::robot_file::robot_model;
use crate::{cross_evaluation, fit_report};

/// Interval at which a running training is saved.
const SAVE_EVERY: Duration = Duration::from_secs(30);

/// Settings of [`fit`] and [`fit_stages`].
#[derive(Clone, Debug)]
pub struct FitOptions {
    /// Measured logs: data files, or folders that contain one.
    pub logs: Vec<PathBuf>,
    /// Number of members of the ensemble.
    pub members: usize,
    /// Number of hidden units of each member's LSTM.
    pub hidden: usize,
    /// Encoding of the joint in the input.
    pub joint_input: JointEncoding,
    /// Input of the networks.
    pub input: NetworkInput,
    /// Model file of the robot whose missing torque alone is learned.
    pub residual: Option<PathBuf>,
    /// Rate to which the logs are resampled [Hz].
    pub rate_hz: Option<f64>,
    /// Maximum number of epochs.
    pub epochs: usize,
    /// Seed of the initial weights and of the order of the data.
    pub seed: u64,
    /// Frequency at which a spline halves the amplitude of the training split [Hz].
    pub smooth_hz: Option<f64>,
    /// Ensemble with whose weights the training starts.
    pub from: Option<PathBuf>,
    /// True to train on the best available GPU.
    pub gpu: bool,
    /// True to continue the training that was interrupted.
    pub resume: bool,
    /// Plot of the learning curves to write (SVG).
    pub plot: Option<PathBuf>,
    /// File to write; folder to write for [`fit_stages`].
    pub out: PathBuf,
}

/// Result of [`fit`].
pub struct Fitted {
    /// The ensemble.
    pub ensemble: Ensemble,
    /// Learning curve of each member.
    pub curves: Vec<Vec<Epoch>>,
    /// Errors and coverage on the test split.
    pub calibration: Calibration,
}

impl Fitted {
    /// Returns the errors and the coverage as text.
    pub fn table(&self) -> String {
        let epochs: Vec<_> = self.curves.iter().map(|curve| curve.len().to_string()).collect();
        let table = fit_report::table(&self.calibration, self.ensemble.description.variance_scale);
        format!("epochs of each member: {}\n{table}", epochs.join(", "))
    }
}

/// Fits one ensemble to all logs (U2E), and writes it.
///
/// An interrupted training is saved beside the file; `resume` continues it.
///
/// ```no_run
/// use twinstep_workflows::{FitOptions, Observer, fit};
///
/// let options = FitOptions::new(vec!["walk-log".into()], "ensemble.safetensors".into());
/// let fitted = fit(&options, &Observer::silent())?;
/// println!("{:.3} N·m", fitted.calibration.rmse);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn fit(options: &FitOptions, observer: &Observer) -> Result<Fitted, Failure> {
    let data = DataSet::with_options(&options.open_logs(observer)?, options.data_options()).map_err(input)?;
    options.plot.as_deref().map_or(Ok(()), chart::check_writable).map_err(input)?;
    let resume =
        if options.resume { Some(Checkpoint::read(&training_file(&options.out)).map_err(input)?) } else { None };
    let (ensemble, curves) = train_and_save(&data, options, &options.out, (resume, observer))?;
    if let Some(path) = &options.plot {
        chart::write(&fit_report::curves_svg(&curves).map_err(other)?, path).map_err(other)?;
    }
    let calibration = Calibration::of(&ensemble, &data);
    Ok(Fitted { ensemble, curves, calibration })
}

/// Fits one ensemble to each log, evaluates each of them on every log (U2E, Fig. 2), and writes them to a folder. Returns the table.
pub fn fit_stages(options: &FitOptions, observer: &Observer) -> Result<String, Failure> {
    let train = |stage: &DataSet, out: &Path| train_or_load(stage, options, out, observer);
    let logs = options.open_logs(observer)?;
    cross_evaluation::run(&logs, options.data_options(), &options.out, train, observer)
}

/// Trains an ensemble and writes it to `out`. Saves an interrupted training in [`training_file`].
fn train_and_save(
    data: &DataSet,
    options: &FitOptions,
    out: &Path,
    (resume, observer): (Option<Checkpoint>, &Observer),
) -> Result<(Ensemble, Vec<Vec<Epoch>>), Failure> {
    let mut training = Training::new(data, options.training()).map_err(input)?;
    if let Some(path) = &options.from {
        training.warm_start(&Ensemble::read(path).map_err(input)?).map_err(input)?;
    }
    if options.gpu {
        observer.note(format_args!("training on {}", training.on_gpu().map_err(input)?));
    }
    // Checked before the training, so that its result cannot be lost.
    check_writable(out).map_err(input)?;
    let saved = training_file(out);
    match train_members(&training, options, &saved, (resume, observer))? {
        Ended::Trained(ensemble, curves) => {
            ensemble.write(out).map_err(other)?;
            if saved.exists() {
                std::fs::remove_file(&saved).map_err(other)?;
            }
            Ok((*ensemble, curves))
        }
        Ended::Interrupted(checkpoint) => {
            checkpoint.write(&saved).map_err(other)?;
            Err(Failure::Interrupted)
        }
    }
}

/// Returns the ensemble of a stage. With `resume`, reads a finished one and continues an interrupted one.
fn train_or_load(stage: &DataSet, options: &FitOptions, out: &Path, observer: &Observer) -> Result<Ensemble, Failure> {
    let saved: PathBuf = training_file(out);
    if options.resume && out.exists() && !saved.exists() {
        let ensemble = Ensemble::read(out).map_err(input)?;
        if ensemble.description.data_hash == stage.hash() {
            return Ok(ensemble);
        }
    }
    let resume = (options.resume && saved.exists()).then(|| Checkpoint::read(&saved)).transpose().map_err(input)?;
    Ok(train_and_save(stage, options, out, (resume, observer))?.0)
}

impl FitOptions {
    /// Returns the options of a fit with default settings to `logs`, which writes the file `out`.
    pub fn new(logs: Vec<PathBuf>, out: PathBuf) -> Self {
        let TrainingOptions { members, hidden, epochs, seed, .. } = TrainingOptions::default();
        Self {
            logs,
            members,
            hidden,
            joint_input: JointEncoding::Pooled,
            input: NetworkInput::Errors,
            residual: None,
            rate_hz: None,
            epochs,
            seed,
            smooth_hz: None,
            from: None,
            gpu: false,
            resume: false,
            plot: None,
            out,
        }
    }

    /// Continues the training that was interrupted, if there is one.
    pub fn resumed_if_interrupted(self) -> Self {
        Self { resume: training_file(&self.out).exists(), ..self }
    }

    /// Opens the logs, with the torque that is learned, at the rate at which it is learned.
    fn open_logs(&self, observer: &Observer) -> Result<Vec<(String, Log)>, Failure> {
        let lacking = self.residual.as_deref().map(|path| robot_model(Some(path))).transpose()?;
        let open = |path: &PathBuf| {
            let (name, mut log) = (path.display().to_string(), open_log(path, observer)?);
            if let Some(rate_hz) = log.measured_hz() {
                return Err(input(SlowSensors { log: name, rate_hz }));
            }
            if let Some(robot) = &lacking {
                log = residual_log(&log, robot)?.ok_or_else(|| input(NoResidual { log: name.clone() }))?;
            }
            if let Some(hz) = self.rate_hz {
                log = log.resampled(hz).map_err(|error| input(WrongRate { log: name.clone(), error }))?;
            }
            Ok((name, log))
        };
        self.logs.iter().map(open).collect()
    }

    fn data_options(&self) -> DataOptions {
        let target = if self.residual.is_some() { NetworkTarget::Residual } else { NetworkTarget::Torque };
        DataOptions { smooth_hz: self.smooth_hz, input: self.input, target }
    }

    fn training(&self) -> TrainingOptions {
        let Self { members, hidden, joint_input, epochs, seed, .. } = *self;
        TrainingOptions { members, hidden, joint_input, epochs, seed }
    }
}

/// The readings of a log repeat.
#[derive(Debug, thiserror::Error)]
#[error(
    "{log}: the sensors repeat: they were measured at {rate_hz:.0} Hz, and a network would learn that they are held as a lag; record \
     them at their own rate"
)]
struct SlowSensors {
    log: String,
    rate_hz: f64,
}

/// A log does not show which torque a model lacks.
#[derive(Debug, thiserror::Error)]
#[error(
    "{log} does not show which torque the model lacks: it needs `tau_measured_*` and `dq_*`, or rows with a fixed base"
)]
struct NoResidual {
    log: String,
}

/// A log cannot be resampled to the rate.
#[derive(Debug, thiserror::Error)]
#[error("`--rate-hz` for {log}: {error}")]
struct WrongRate {
    log: String,
    error: ResampleError,
}

/// Returns the log of the torque that `robot` lacks: at the log's sensor or, without one, at the joint output.
fn residual_log(log: &Log, robot: &RobotModel) -> Result<Option<Log>, Failure> {
    let at_sensor = residual_at_sensor(log, robot).map_err(input)?;
    if at_sensor.is_some() { Ok(at_sensor) } else { residual_at_output(log, robot).map_err(input) }
}

/// Returns the file in which an unfinished training is saved.
fn training_file(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".training");
    name.into()
}

/// Returns an error if no file can be created next to `out`.
fn check_writable(out: &Path) -> Result<(), EnsembleError> {
    let path = training_file(out);
    let created = std::fs::OpenOptions::new().append(true).create(true).open(&path);
    let empty = created.and_then(|file| Ok(file.metadata()?.len() == 0));
    let removed = empty.and_then(|empty| if empty { std::fs::remove_file(&path) } else { Ok(()) });
    removed.map_err(|cause| EnsembleError::File { verb: "write", path: out.to_owned(), cause })
}

fn train_members(
    training: &Training,
    options: &FitOptions,
    saved: &Path,
    (resume, observer): (Option<Checkpoint>, &Observer),
) -> Result<Ended, Failure> {
    let an_epoch = training.sequences_an_epoch();
    let done_before: usize = resume.iter().flat_map(Checkpoint::curves).map(|curve| curve.len() * an_epoch).sum();
    let sequences = options.members * options.epochs * an_epoch;
    let bar = observer.bar(sequences as u64, "{bar:30} {percent} %, {per_sec}, ETA at most {eta}  {msg}");
    bar.inc(done_before as u64);
    bar.reset_eta();
    let (mut unwritable, mut last_save) = (None, None::<Instant>);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let result = training.run(threads, resume, &mut |progress| {
        match progress {
            TrainingEvent::Sequences(count) => bar.inc(count as u64),
            TrainingEvent::Epoch { member, done, curve, checkpoint } => {
                let (number, epoch) = (curve.len(), curve[curve.len() - 1]);
                let Epoch { training_nll, validation_nll } = epoch;
                bar.set_message(format!(
                    "member {}, epoch {number}: training NLL {training_nll:.3}, validation NLL {validation_nll:.3}",
                    member + 1
                ));
                if done {
                    bar.set_length(bar.length().unwrap_or(0) - ((options.epochs - number) * an_epoch) as u64);
                }
                if last_save.is_none_or(|last| last.elapsed() > SAVE_EVERY) {
                    unwritable = checkpoint.write(saved).err();
                    last_save = Some(Instant::now());
                }
            }
            TrainingEvent::Tick => {}
        }
        unwritable.is_none() && !observer.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    unwritable.map_or(Ok(()), |error| Err(other(error)))?;
    result.map_err(|error| match error {
        EnsembleError::Diverged { .. } => other(error),
        _ => input(error),
    })
}
