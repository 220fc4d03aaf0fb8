//! `twinstep identify`: estimates model parameters from measured logs.

use std::path::PathBuf;

use twinstep_identify::IdentifyOptions as SearchOptions;
use twinstep_workflows::identify::search_file;
use twinstep_workflows::{IdentifyOptions, Observer, identify};

use crate::evaluate::Rows;
use crate::exit::{CommandResult, Failure};

/// Estimate the parameters of effects from measured logs (sampling-based parameter identification, SPI-Active).
///
/// The log's commands are simulated with thousands of candidate parameter sets in the batch engine. The simulations are
/// compared with the measurements, each channel in units of its noise. CMA-ES performs the global search;
/// Levenberg–Marquardt refines its result. If a segment has a floating base, CMA-ES then searches within the uncertainty
/// of the estimate. Every estimate has a 95 % interval. Before the search, the identifiability
/// of each parameter from the logs is predicted. A parameter that is not identifiable keeps its initial value and is
/// reported, unless --force is given. Highly correlated parameters are reported with an experiment that separates them.
///
/// `twinstep serve --model` and `twinstep evaluate --model` load the model file. Ctrl-C interrupts the search, writes
/// the best estimates so far and saves the search in OUT.search.json. The same command with --resume continues from
/// there; the refinement and the local search begin again.
///
/// A robot that is not like the Go2 (an arm, a humanoid; `--model arm.xml`), a log without gains, and effects `@each` joint need segments
/// with a fixed base. There Levenberg-Marquardt alone fits the positions, and torques of motor currents, to windows of 4 s. Priors scale with the
/// torque limits of the joints. The model file states what is added to the robot file. Ctrl-C ends it with the best values so far.
///
/// Examples: `twinstep identify data/go2_air_chirp --until 10 --out fitted.toml` and
/// `twinstep identify --model arm.xml arm_log --segment sines --out arm.toml`
#[derive(clap::Args)]
pub struct Args {
    /// Measured logs: data files, or folders that contain one. Segments may have a fixed or a floating base.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Model file to start from. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Model file of an earlier identification, from whose values the search starts. An effect that it lacks starts as in
    /// --model, or with no effect.
    #[arg(long, value_name = "FILE")]
    start: Option<PathBuf>,
    /// Effects to estimate, with scopes, as in `coulomb_friction@calf,payload@base`. `twinstep effects` lists them.
    /// Default: armature, Coulomb and viscous friction by joint type, and the command delay.
    ///
    /// A robot of any tree: armature, viscous_friction, coulomb_friction, command_delay and pd_gain, at `all` joints (one value),
    /// `each` joint, or one. Default: the first three at each joint and one delay. Gains that the log does not state are estimated, too.
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    effects: Option<Vec<String>>,
    #[command(flatten)]
    rows: Rows,
    /// Estimate parameters that are not identifiable from the logs, too.
    #[arg(long)]
    force: bool,
    /// Maximum number of generations of CMA-ES, which a robot of any tree does not need. With 0 there is no local search either: gradient steps alone
    /// (Levenberg–Marquardt), from the values of --start or of the model.
    #[arg(long, value_name = "N", default_value_t = SearchOptions::default().generations)]
    generations: usize,
    /// Seed of the search.
    #[arg(long, default_value_t = SearchOptions::default().seed)]
    seed: u64,
    /// Continue the interrupted search in OUT.search.json.
    #[arg(long)]
    resume: bool,
    /// Model file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Estimates the parameters, writes the model, and says how to evaluate it.
pub fn run(args: &Args) -> CommandResult {
    let found = identify(&args.options(), &Observer::terminal()?)?;
    print!("{}", found.text());
    println!("written to {}; evaluate it on other rows: twinstep evaluate --model", args.out.display());
    if found.is_interrupted {
        if search_file(&args.out).exists() {
            println!("interrupted; the same command with --resume continues");
        }
        return Err(Failure::Interrupted);
    }
    Ok(())
}

impl Args {
    fn options(&self) -> IdentifyOptions {
        IdentifyOptions {
            logs: self.logs.clone(),
            model: self.model.clone(),
            start: self.start.clone(),
            effects: self.effects.clone(),
            rows: self.rows.selection(),
            force: self.force,
            generations: self.generations,
            seed: self.seed,
            resume: self.resume,
            out: self.out.clone(),
        }
    }
}
