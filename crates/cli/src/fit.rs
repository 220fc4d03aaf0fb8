//! `twinstep fit`: an ensemble of actuator networks from measured logs.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_ensemble::{
    Calibration, Checkpoint, Coverage, DataSet, Ensemble, EnsembleError, Epoch, JointEncoding, TrainingOptions, TrainingResult as Ended,
    TrainingEvent, Training,
};
use twinstep_logs::Log;

use twinstep_report::chart::{self, HPos, RGBColor, GREY, Line, ORANGE, Panel, PlotError};
use crate::cross_evaluation;
use crate::exit::{Failure, CommandResult, Signals, input, other};

/// How often a running training is saved.
const SAVE_EVERY: Duration = Duration::from_secs(30);
/// Width and height of the learning curves [px].
const SIZE: (u32, u32) = (900, 600);

/// Learn a robot's actuators from measured logs: an ensemble of networks that knows what it does not know (U2E).
///
/// Each network sees a joint's position and velocity error, row after row, and gives its torque as a mean and a variance.
/// Networks that began differently agree on what they have seen and disagree elsewhere. The logs need `tau_measured_*`, one
/// rate and constant gains; torque beside the gains (`tau_ff_*`) is refused. Velocity that was not measured is the central
/// difference of position.
///
/// Of every ten stretches of time eight are learnt from, one says when to stop and how wide intervals have to be, and the last
/// one judges: its torque error, and how often the truth lies inside the intervals, are printed, before and after the
/// variances were scaled.
///
/// Ctrl-C ends the training and keeps it in OUT.training, from which the same command with --resume goes on; it is saved there
/// after the first epoch and every 30 s too.
///
/// With --cross each log is a stage of a collection of data: an ensemble learns from each alone and is judged by the left-out
/// stretches of every stage, as in Fig. 2 of U2E. OUT is a folder then, with `1.safetensors` and so on, the grid as
/// `cross.svg`, and its numbers as `cross.csv`.
///
/// Example: `twinstep fit walk.parquet jump.parquet --out ensemble.safetensors --plot curves.svg`
#[derive(clap::Args)]
pub struct Args {
    /// The logs: data files, or folders that hold one.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Number of networks.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().members)]
    members: usize,
    /// Units of each network's LSTM.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().hidden)]
    hidden: usize,
    /// What a network is told of the joint: nothing, as in U2E; hip, thigh or calf; or which one it is.
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = JointEncodingArg::Pooled)]
    joint_input: JointEncodingArg,
    /// Most passes over the data; most trainings end before, when the left-out stretches are predicted no better.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().epochs)]
    epochs: usize,
    /// Seed of the networks' first weights and of the order of the data.
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    seed: u64,
    /// Smooth what is learnt from by a cubic spline, as U2E does: waves of so many Hz have half their amplitude. What stops the
    /// training and what judges it stay as measured.
    #[arg(long, value_name = "HZ")]
    pub smooth: Option<f64>,
    /// Train on the best GPU there is (builds with `--features gpu`); the numbers differ from the CPU's by rounding.
    #[arg(long)]
    gpu: bool,
    /// Go on with the training that ended, from OUT.training.
    #[arg(long)]
    resume: bool,
    /// Draw the learning curves.
    #[arg(long, value_name = "FILE.svg", conflicts_with = "cross")]
    plot: Option<PathBuf>,
    /// Learn from each log alone, and judge each ensemble by every log.
    #[arg(long)]
    cross: bool,
    /// The file to write (safetensors); with --cross the folder.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// [`JointEncoding`] by its name.
#[derive(Clone, Copy, ValueEnum)]
enum JointEncodingArg {
    Pooled,
    Kind,
    Identity,
}

/// Trains, judges, prints and writes.
pub fn run(args: &Args) -> CommandResult {
    let mut logs = Vec::new();
    for path in &args.logs {
        logs.push((path.display().to_string(), Log::open(path).map_err(input)?));
    }
    let data = DataSet::smoothed(&logs, args.smooth).map_err(input)?;
    if args.cross {
        return cross_evaluation::run(&logs, args);
    }
    args.plot.as_deref().map_or(Ok(()), chart::check_writable).map_err(input)?;
    let resume = if args.resume { Some(Checkpoint::read(&training_file(&args.out)).map_err(input)?) } else { None };
    let (ensemble, curves) = train_and_save(&data, args, &args.out, resume)?;
    if let Some(path) = &args.plot {
        chart::write(&curves_svg(&curves).map_err(other)?, path).map_err(other)?;
    }
    let epochs: Vec<_> = curves.iter().map(|curve| curve.len().to_string()).collect();
    println!("epochs of each member: {}", epochs.join(", "));
    print!("{}", text(&Calibration::of(&ensemble, &data), ensemble.description.variance_scale));
    println!("written to {}", args.out.display());
    Ok(())
}

/// Trains an ensemble and writes it to `out`; what is interrupted is kept beside it.
pub fn train_and_save(
    data: &DataSet,
    args: &Args,
    out: &Path,
    resume: Option<Checkpoint>,
) -> Result<(Ensemble, Vec<Vec<Epoch>>), Failure> {
    let mut training = Training::new(data, args.options()).map_err(input)?;
    if args.gpu {
        println!("training on {}", training.on_gpu().map_err(input)?);
    }
    // Before the training, not after it: what was learnt must not be lost.
    check_writable(out).map_err(input)?;
    let saved = training_file(out);
    match train(&training, args, &saved, resume)? {
        Ended::Trained(ensemble, curves) => {
            ensemble.write(out).map_err(other)?;
            if saved.exists() {
                std::fs::remove_file(&saved).map_err(other)?;
            }
            Ok((*ensemble, curves))
        }
        Ended::Interrupted(checkpoint) => {
            checkpoint.write(&saved).map_err(other)?;
            println!("ended before it was done; the same command with --resume goes on");
            Err(Failure::Interrupted)
        }
    }
}

impl Args {
    /// Whether a training that ended is to go on.
    pub fn resumes(&self) -> bool {
        self.resume
    }

    fn options(&self) -> TrainingOptions {
        let joint_input = match self.joint_input {
            JointEncodingArg::Pooled => JointEncoding::Pooled,
            JointEncodingArg::Kind => JointEncoding::Kind,
            JointEncodingArg::Identity => JointEncoding::Identity,
        };
        TrainingOptions { members: self.members, hidden: self.hidden, joint_input, epochs: self.epochs, seed: self.seed }
    }
}

/// Where a training that has not ended is kept.
pub fn training_file(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".training");
    name.into()
}

/// Fails if no file can be made beside `out`.
fn check_writable(out: &Path) -> Result<(), EnsembleError> {
    let beside = training_file(out);
    let made = std::fs::OpenOptions::new().append(true).create(true).open(&beside);
    let empty = made.and_then(|file| Ok(file.metadata()?.len() == 0));
    let cleaned = empty.and_then(|empty| if empty { std::fs::remove_file(&beside) } else { Ok(()) });
    cleaned.map_err(|cause| EnsembleError::File { verb: "write", path: out.to_owned(), cause })
}

fn train(training: &Training, args: &Args, saved: &Path, resume: Option<Checkpoint>) -> Result<Ended, Failure> {
    let signals = Signals::listen()?;
    let an_epoch = training.sequences_an_epoch();
    let done_before: usize = resume.iter().flat_map(Checkpoint::curves).map(|curve| curve.len() * an_epoch).sum();
    let bar = progress_bar(args.members * args.epochs * an_epoch);
    bar.inc(done_before as u64);
    bar.reset_eta();
    let (mut unwritable, mut last_save) = (None, None::<Instant>);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let ended = training.run(threads, resume, &mut |progress| {
        match progress {
            TrainingEvent::Sequences(count) => bar.inc(count as u64),
            TrainingEvent::Epoch { member, done, curve, checkpoint } => {
                let (number, epoch) = (curve.len(), curve[curve.len() - 1]);
                let Epoch { training_nll, validation_nll } = epoch;
                bar.set_message(format!(
                    "member {}, epoch {number}: NLL {training_nll:.3}, left out {validation_nll:.3}",
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
    ended.map_err(|error| match error {
        EnsembleError::Diverged { .. } => other(error),
        _ => input(error),
    })
}

fn progress_bar(sequences: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {percent} %, {per_sec}, ETA at most {eta}  {msg}");
    ProgressBar::new(sequences as u64).with_style(style.expect("a template"))
}

/// A line a member and one of their mixture, before and after its variances were scaled.
fn text(found: &Calibration, variance_scale: f64) -> String {
    let mut lines = vec![
        format!("judged by {} rows that nothing was learnt from or fitted to", found.rows),
        format!("torque error of the members' mean: {:.4} N·m (RMSE)", found.rmse),
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

/// Negative log-likelihood of every member over its epochs.
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
        caption: format!("{} networks learn", curves.len()),
        x_label: "passes over the data",
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
        let names = [("learnt from", GREY), ("left out", ORANGE)];
        chart::legend(root, &names, 420, (900, 120))?;
        chart::text(root, "each line is one network", 34, HPos::Left, (900, 180))
    })
}
