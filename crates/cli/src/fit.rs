//! `twinstep fit`: trains an ensemble of actuator networks on measured logs.

use std::path::PathBuf;

use clap::ValueEnum;
use twinstep_ensemble::{JointEncoding, NetworkInput, TrainingOptions};
use twinstep_workflows::{FitOptions, Observer, fit, fit_stages};

use crate::exit::{CommandResult, Failure};

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
    logs: Vec<PathBuf>,
    /// Number of members of the ensemble.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().members)]
    members: usize,
    /// Number of hidden units of each member's LSTM.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().hidden)]
    hidden: usize,
    /// Encoding of the joint in the input: none, as in U2E (pooled), the joint type (kind), or the joint (identity).
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = JointEncodingArg::Pooled)]
    joint_input: JointEncodingArg,
    /// Input of the networks: position and velocity error, as in U2E (errors), or the torque that was asked for and the
    /// velocity (torque), which serves all gains and feed-forward torque.
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = NetworkInputArg::Errors)]
    input: NetworkInputArg,
    /// Learn only the torque that the robot of this model file lacks, for `[actuator] mode = "residual"`. Logs without
    /// torque are enough if the base is fixed.
    #[arg(long, value_name = "FILE")]
    residual: Option<PathBuf>,
    /// Resample the logs to this rate, at most theirs [Hz]. The ensemble is evaluated at this rate in every simulator.
    #[arg(long, value_name = "HZ")]
    rate_hz: Option<f64>,
    /// Maximum number of epochs. Most trainings end earlier, by early stopping on the validation split.
    #[arg(long, value_name = "N", default_value_t = TrainingOptions::default().epochs)]
    epochs: usize,
    /// Seed of the initial weights and of the order of the data.
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    seed: u64,
    /// Smooth the training split with a cubic spline, as U2E does. The spline halves the amplitude at this frequency
    /// [Hz]. The validation and test splits stay as measured.
    #[arg(long, value_name = "HZ")]
    smooth: Option<f64>,
    /// Start with the weights of this ensemble, trained on earlier data with the same settings, instead of random ones.
    #[arg(long, value_name = "FILE", conflicts_with = "cross")]
    from: Option<PathBuf>,
    /// Train on the best available GPU (builds with `--features gpu`). Results differ from the CPU's by rounding.
    #[arg(long)]
    gpu: bool,
    /// Continue the interrupted training in OUT.training.
    #[arg(long)]
    resume: bool,
    /// Write a plot of the learning curves.
    #[arg(long, value_name = "FILE.svg", conflicts_with = "cross")]
    plot: Option<PathBuf>,
    /// Train one ensemble per log, and evaluate each of them on every log.
    #[arg(long)]
    cross: bool,
    /// File to write (safetensors); with --cross, folder to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// [`NetworkInput`] as a value of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum NetworkInputArg {
    /// Position and velocity error.
    Errors,
    /// The torque that was asked for, and the velocity.
    Torque,
}

/// [`JointEncoding`] as a value of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum JointEncodingArg {
    /// The joint is not an input.
    Pooled,
    /// The joint type.
    Kind,
    /// The joint.
    Identity,
}

/// Trains, evaluates and writes the ensemble.
pub fn run(args: &Args) -> CommandResult {
    let (options, observer) = (args.options(), Observer::terminal()?);
    let table = if args.cross {
        fit_stages(&options, &observer)
    } else {
        fit(&options, &observer).map(|fitted| fitted.table())
    };
    match &table {
        Ok(table) => println!("{table}written to {}", args.out.display()),
        Err(Failure::Interrupted) => println!("interrupted; the same command with --resume continues"),
        Err(_) => {}
    }
    table.map(drop)
}

impl Args {
    fn options(&self) -> FitOptions {
        FitOptions {
            members: self.members,
            hidden: self.hidden,
            joint_input: match self.joint_input {
                JointEncodingArg::Pooled => JointEncoding::Pooled,
                JointEncodingArg::Kind => JointEncoding::Kind,
                JointEncodingArg::Identity => JointEncoding::Identity,
            },
            input: match self.input {
                NetworkInputArg::Errors => NetworkInput::Errors,
                NetworkInputArg::Torque => NetworkInput::Torque,
            },
            residual: self.residual.clone(),
            rate_hz: self.rate_hz,
            epochs: self.epochs,
            seed: self.seed,
            smooth_hz: self.smooth,
            from: self.from.clone(),
            gpu: self.gpu,
            resume: self.resume,
            plot: self.plot.clone(),
            ..FitOptions::new(self.logs.clone(), self.out.clone())
        }
    }
}
