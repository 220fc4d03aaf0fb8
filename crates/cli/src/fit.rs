//! `twinstep fit`: trains an ensemble of actuator networks on measured logs.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};
use twinstep_ensemble::{
    Calibration, Checkpoint, Coverage, DataOptions, DataSet, Ensemble, EnsembleError, Epoch, JointEncoding,
    NetworkInput, NetworkTarget, Training, TrainingEvent, TrainingOptions, TrainingResult as Ended,
};
use twinstep_identify::{residual_at_output, residual_at_sensor};
use twinstep_logs::{Log, ResampleError};
use twinstep_model::RobotModel;

use crate::cross_evaluation;
use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::open_log::open_log;
use crate::robot_file::robot_model;
use twinstep_report::chart::{self, GREY, HPos, Line, ORANGE, Panel, PlotError};

/// Interval at which a running training is saved.
const SAVE_EVERY: Duration = Duration::from_secs(30);
/// Width and height of the plot of the learning curves [px].
const SIZE: (u32, u32) = (900, 600);

/// Train an ensemble of actuator networks on measured logs (U2E).
///
/// Each network receives two numbers of one joint, row after row, and predicts the mean and variance of its torque.
/// The numbers are the position and velocity error or, with --input torque, the torque that was asked for and the velocity. The members start from different initial weights. They agree on motion like the training
/// data and disagree elsewhere; this gives the epistemic uncertainty of each prediction. The logs need
/// `tau_measured_*` and one rate. Without --input torque they also need constant gains and no feed-forward torque
/// (`tau_ff_*`). A velocity that was not measured is replaced by the central difference of the position.
///
/// Each log is cut into blocks. Of every ten blocks, eight are the training split, one is the validation split and one
/// is the test split. The validation split is used for early stopping and for one factor that scales all variances. The
/// command prints the torque error and the coverage of the intervals on the test split, before and after scaling.
///
/// Ctrl-C interrupts the training and saves it in OUT.training. The same command with --resume continues from there.
/// The training is also saved there after the first epoch and every 30 s.
///
/// With --cross each log is one stage of a data collection. One ensemble is trained per stage and evaluated on the test
/// split of every stage (U2E, Fig. 2). OUT is then a folder with `1.safetensors` and so on, the grid of plots
/// `cross.svg` and the table `cross.csv`.
///
/// Examples: `twinstep fit walk.parquet jump.parquet --out ensemble.safetensors --plot curves.svg`, and
/// `twinstep fit walk --residual extended.toml --input torque --rate-hz 200 --out residual.safetensors`
#[derive(clap::Args)]
pub struct Args {
    /// Measured logs: data files, or folders that contain one.
    #[arg(required = true)]
    pub logs: Vec<PathBuf>,
    /// Number of members of the ensemble.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().members)]
    pub members: usize,
    /// Number of hidden units of each member's LSTM.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().hidden)]
    pub hidden: usize,
    /// Encoding of the joint in the input: none, as in U2E (pooled), the joint type (kind), or the joint (identity).
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = JointEncodingArg::Pooled)]
    pub joint_input: JointEncodingArg,
    /// Input of the networks: position and velocity error, as in U2E (errors), or the torque that was asked for and the
    /// velocity (torque), which serves all gains and feed-forward torque.
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = NetworkInputArg::Errors)]
    pub input: NetworkInputArg,
    /// Learn only the torque that the robot of this model file lacks, for `[actuator] mode = "residual"`. Logs without
    /// torque are enough if the base is fixed.
    #[arg(long, value_name = "FILE")]
    pub residual: Option<PathBuf>,
    /// Resample the logs to this rate, at most theirs [Hz]. The ensemble is evaluated at this rate in every simulator.
    #[arg(long, value_name = "HZ")]
    pub rate_hz: Option<f64>,
    /// Maximum number of epochs. Most trainings end earlier, by early stopping on the validation split.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().epochs)]
    pub epochs: usize,
    /// Seed of the initial weights and of the order of the data.
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    pub seed: u64,
    /// Smooth the training split with a cubic spline, as U2E does. The spline halves the amplitude at this frequency
    /// [Hz]. The validation and test splits stay as measured.
    #[arg(long, value_name = "HZ")]
    pub smooth: Option<f64>,
    /// Start with the weights of this ensemble, trained on earlier data with the same settings, instead of random ones.
    #[arg(long, value_name = "FILE", conflicts_with = "cross")]
    pub from: Option<PathBuf>,
    /// Train on the best available GPU (builds with `--features gpu`). Results differ from the CPU's by rounding.
    #[arg(long)]
    pub gpu: bool,
    /// Continue the interrupted training in OUT.training.
    #[arg(long)]
    pub resume: bool,
    /// Write a plot of the learning curves.
    #[arg(long, value_name = "FILE.svg", conflicts_with = "cross")]
    pub plot: Option<PathBuf>,
    /// Train one ensemble per log, and evaluate each of them on every log.
    #[arg(long)]
    pub cross: bool,
    /// File to write (safetensors); with --cross, folder to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// [`NetworkInput`] as a value of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum NetworkInputArg {
    /// Position and velocity error.
    Errors,
    /// The torque that was asked for, and the velocity.
    Torque,
}

/// [`JointEncoding`] as a value of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointEncodingArg {
    /// The joint is not an input.
    Pooled,
    /// The joint type.
    Kind,
    /// The joint.
    Identity,
}

/// Trains, evaluates and writes the ensemble.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    let result = if args.cross {
        let train = |stage: &DataSet, out: &Path| train_or_load(stage, args, out, &signals);
        args.open_logs().and_then(|logs| cross_evaluation::run(&logs, args.data_options(), &args.out, train))
    } else {
        write_ensemble(args, &signals)
    };
    if matches!(result, Err(Failure::Interrupted)) {
        println!("interrupted; the same command with --resume continues");
    }
    result
}

/// Trains and evaluates one ensemble of all logs, and writes it.
pub fn write_ensemble(args: &Args, signals: &Signals) -> CommandResult {
    let data = DataSet::with_options(&args.open_logs()?, args.data_options()).map_err(input)?;
    args.plot.as_deref().map_or(Ok(()), chart::check_writable).map_err(input)?;
    let resume = if args.resume { Some(Checkpoint::read(&training_file(&args.out)).map_err(input)?) } else { None };
    let (ensemble, curves) = train_and_save(&data, args, &args.out, (resume, signals))?;
    if let Some(path) = &args.plot {
        chart::write(&curves_svg(&curves).map_err(other)?, path).map_err(other)?;
    }
    let epochs: Vec<_> = curves.iter().map(|curve| curve.len().to_string()).collect();
    println!("epochs of each member: {}", epochs.join(", "));
    print!("{}", text(&Calibration::of(&ensemble, &data), ensemble.description.variance_scale));
    println!("written to {}", args.out.display());
    Ok(())
}

/// Trains an ensemble and writes it to `out`. Saves an interrupted training in [`training_file`].
fn train_and_save(
    data: &DataSet,
    args: &Args,
    out: &Path,
    (resume, signals): (Option<Checkpoint>, &Signals),
) -> Result<(Ensemble, Vec<Vec<Epoch>>), Failure> {
    let mut training = Training::new(data, args.options()).map_err(input)?;
    if let Some(path) = &args.from {
        training.warm_start(&Ensemble::read(path).map_err(input)?).map_err(input)?;
    }
    if args.gpu {
        println!("training on {}", training.on_gpu().map_err(input)?);
    }
    // Checked before the training, so that its result cannot be lost.
    check_writable(out).map_err(input)?;
    let saved = training_file(out);
    match train(&training, args, &saved, (resume, signals))? {
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

/// Returns the ensemble of a stage. With --resume, reads a finished one and continues an interrupted one.
fn train_or_load(stage: &DataSet, args: &Args, out: &Path, signals: &Signals) -> Result<Ensemble, Failure> {
    let saved: PathBuf = training_file(out);
    if args.resume && out.exists() && !saved.exists() {
        let ensemble = Ensemble::read(out).map_err(input)?;
        if ensemble.description.data_hash == stage.hash() {
            return Ok(ensemble);
        }
    }
    let resume = (args.resume && saved.exists()).then(|| Checkpoint::read(&saved)).transpose().map_err(input)?;
    Ok(train_and_save(stage, args, out, (resume, signals))?.0)
}

impl Args {
    /// Returns the arguments of a training with default settings from `logs`, which writes the file `out`.
    pub fn new(logs: Vec<PathBuf>, out: PathBuf) -> Self {
        let TrainingOptions { members, hidden, epochs, seed, .. } = TrainingOptions::default();
        Self {
            logs,
            members,
            hidden,
            joint_input: JointEncodingArg::Pooled,
            input: NetworkInputArg::Errors,
            residual: None,
            rate_hz: None,
            epochs,
            seed,
            smooth: None,
            from: None,
            gpu: false,
            resume: false,
            plot: None,
            cross: false,
            out,
        }
    }

    /// Continues the training that was interrupted, if there is one.
    pub fn resumed_if_interrupted(self) -> Self {
        Self { resume: training_file(&self.out).exists(), ..self }
    }

    /// Opens the logs, with the torque that is learned, at the rate at which it is learned.
    fn open_logs(&self) -> Result<Vec<(String, Log)>, Failure> {
        let lacking = self.residual.as_deref().map(|path| robot_model(Some(path))).transpose()?;
        let open = |path: &PathBuf| {
            let (name, mut log) = (path.display().to_string(), open_log(path)?);
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
        DataOptions {
            smooth_hz: self.smooth,
            input: match self.input {
                NetworkInputArg::Errors => NetworkInput::Errors,
                NetworkInputArg::Torque => NetworkInput::Torque,
            },
            target: if self.residual.is_some() { NetworkTarget::Residual } else { NetworkTarget::Torque },
        }
    }

    fn options(&self) -> TrainingOptions {
        let joint_input = match self.joint_input {
            JointEncodingArg::Pooled => JointEncoding::Pooled,
            JointEncodingArg::Kind => JointEncoding::Kind,
            JointEncodingArg::Identity => JointEncoding::Identity,
        };
        TrainingOptions {
            members: self.members,
            hidden: self.hidden,
            joint_input,
            epochs: self.epochs,
            seed: self.seed,
        }
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

fn train(
    training: &Training,
    args: &Args,
    saved: &Path,
    (resume, signals): (Option<Checkpoint>, &Signals),
) -> Result<Ended, Failure> {
    let an_epoch = training.sequences_an_epoch();
    let done_before: usize = resume.iter().flat_map(Checkpoint::curves).map(|curve| curve.len() * an_epoch).sum();
    let bar = progress_bar(args.members * args.epochs * an_epoch);
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
                    bar.set_length(bar.length().unwrap_or(0) - ((args.epochs - number) * an_epoch) as u64);
                }
                if last_save.is_none_or(|last| last.elapsed() > SAVE_EVERY) {
                    unwritable = checkpoint.write(saved).err();
                    last_save = Some(Instant::now());
                }
            }
            TrainingEvent::Tick => {}
        }
        unwritable.is_none() && !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    unwritable.map_or(Ok(()), |error| Err(other(error)))?;
    result.map_err(|error| match error {
        EnsembleError::Diverged { .. } => other(error),
        _ => input(error),
    })
}

fn progress_bar(sequences: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {percent} %, {per_sec}, ETA at most {eta}  {msg}");
    ProgressBar::new(sequences as u64).with_style(style.expect("a template"))
}

/// Returns a table with two lines per member and for their mixture: before and after scaling the variances.
fn text(found: &Calibration, variance_scale: f64) -> String {
    let mut lines = vec![
        format!("evaluated on {} held-out rows", found.rows),
        format!("torque RMSE of the members' mean: {:.4} N·m", found.rmse),
        format!("mean standard deviation: {:.4} N·m, all variances scaled by {variance_scale:.3}", found.sharpness),
        format!(
            "{:<22}{:>7}{:>7}{:>7}  {:>12}  {:>8}",
            "intervals cover", "50 %", "90 %", "95 %", "PIT distance", "NLL"
        ),
    ];
    let names = (1..=found.members.len()).map(|number| format!("member {number}")).chain(["mixture".to_owned()]);
    for (name, [before, after]) in names.zip(found.members.iter().chain([&found.mixture])) {
        lines.push(line(&name, before));
        lines.push(line(&format!("{name}, scaled"), after));
    }
    lines.join("\n") + "\n"
}

fn line(name: &str, coverage: &Coverage) -> String {
    let [half, ninety, more] = coverage.empirical.map(|share| 100.0 * share);
    let Coverage { pit_ks_statistic: pit_distance, nll, .. } = coverage;
    format!("{name:<22}{half:>7.1}{ninety:>7.1}{more:>7.1}  {pit_distance:>12.3}  {nll:>8.3}")
}

/// Plots the negative log-likelihood of every member over its epochs.
fn curves_svg(curves: &[Vec<Epoch>]) -> Result<String, PlotError> {
    let of = |value: fn(&Epoch) -> f64| {
        let points = move |curve: &Vec<Epoch>| {
            curve.iter().enumerate().map(|(index, epoch)| ((index + 1) as f64, value(epoch))).collect::<Vec<_>>()
        };
        curves.iter().map(points).collect::<Vec<_>>()
    };
    let (training, validation) = (of(|epoch| epoch.training_nll), of(|epoch| epoch.validation_nll));
    let longest = curves.iter().map(Vec::len).max().unwrap_or(1).max(2);
    let values = training.iter().chain(&validation).flatten().map(|(_, nll)| *nll);
    let panel = Panel {
        caption: format!("Training of {} networks", curves.len()),
        x_label: "epoch",
        y_label: "negative log-likelihood [nat]",
        x: 1.0..longest as f64,
        y: chart::range(values),
        lines: vec![
            Line { colour: GREY, width: 3, pieces: training.clone() },
            Line { colour: ORANGE, width: 3, pieces: validation.clone() },
        ],
    };
    chart::picture(SIZE, |root| {
        panel.draw(root)?;
        let names = [("training", GREY), ("validation", ORANGE)];
        chart::legend(root, &names, 420, (900, 120))?;
        chart::text(root, "each line is one network", 34, HPos::Left, (900, 180))
    })
}
