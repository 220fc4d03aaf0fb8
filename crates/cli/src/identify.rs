//! `twinstep identify`: estimates model parameters from measured logs.

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_effects::{Effect, Scope};
use twinstep_identify::{
    DEFAULT_EFFECTS, EffectAtScope, EffectAtScopeError, EstimateStatus, Experiment, GlobalSearch, Identification,
    IdentifyOptions, ParameterEstimate, Stage, WindowConfig, evaluate, identify,
};
use twinstep_logs::Log;

use crate::evaluate::Rows;
use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::identify_tree::{self, Unwritable};
use crate::open_log::open_log;
use crate::robot_file::{analytic_model, simulator};
use crate::tree_model::{of_any_tree, tree_model};

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
    pub logs: Vec<PathBuf>,
    /// Model file to start from. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Model file of an earlier identification, from whose values the search starts. An effect that it lacks starts as in
    /// --model, or with no effect.
    #[arg(long, value_name = "FILE")]
    pub start: Option<PathBuf>,
    /// Effects to estimate, with scopes, as in `coulomb_friction@calf,payload@base`. `twinstep effects` lists them.
    /// Default: armature, Coulomb and viscous friction by joint type, and the command delay.
    ///
    /// A robot of any tree: armature, viscous_friction, coulomb_friction, command_delay and pd_gain, at `all` joints (one value),
    /// `each` joint, or one. Default: the first three at each joint and one delay. Gains that the log does not state are estimated, too.
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub effects: Option<Vec<String>>,
    #[command(flatten)]
    pub rows: Rows,
    /// Estimate parameters that are not identifiable from the logs, too.
    #[arg(long)]
    pub force: bool,
    /// Maximum number of generations of CMA-ES, which a robot of any tree does not need. With 0 there is no local search either: gradient steps alone
    /// (Levenberg–Marquardt), from the values of --start or of the model.
    #[arg(long, value_name = "N", default_value_t = IdentifyOptions::default().generations)]
    pub generations: usize,
    /// Seed of the search.
    #[arg(long, default_value_t = IdentifyOptions::default().seed)]
    pub seed: u64,
    /// Continue the interrupted search in OUT.search.json.
    #[arg(long)]
    pub resume: bool,
    /// Model file to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

impl Args {
    /// Returns the arguments without logs and effects that write the model file `out`.
    pub fn new(out: &Path) -> Self {
        let IdentifyOptions { generations, seed, .. } = IdentifyOptions::default();
        Self {
            logs: Vec::new(),
            model: None,
            start: None,
            effects: None,
            rows: Rows::default(),
            force: false,
            generations,
            seed,
            resume: false,
            out: out.to_owned(),
        }
    }
}

/// A flag is not for robots of any tree.
#[derive(Debug, thiserror::Error)]
#[error("`{flag}` is for quadrupeds like the Go2; a robot of any tree has {instead}")]
struct FlagOfQuadrupeds {
    flag: &'static str,
    instead: &'static str,
}

/// An entry of `--effects` is not an effect with its scope.
#[derive(Debug, thiserror::Error)]
#[error("`--effects`: {0}")]
struct EffectsError(EffectAtScopeError);

/// The saved search cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("cannot resume from {}: {cause}\n  omit --resume to start a new search", path.display())]
struct NotResumable {
    path: PathBuf,
    cause: String,
}

/// Returns the file in which an interrupted search is saved.
pub fn search_file(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".search.json");
    name.into()
}

fn resumed(path: &Path) -> Result<GlobalSearch, NotResumable> {
    let failed = |cause: String| NotResumable { path: path.to_owned(), cause };
    let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
    serde_json::from_str(&text).map_err(|error| failed(error.to_string()))
}

/// Estimates the parameters, writes the model, and says how to evaluate it.
pub fn run(args: &Args) -> CommandResult {
    let identified = write_model(args, &Signals::listen()?);
    if matches!(identified, Ok(()) | Err(Failure::Interrupted)) {
        println!("written to {}; evaluate it on other rows: twinstep evaluate --model", args.out.display());
    }
    if matches!(identified, Err(Failure::Interrupted)) && search_file(&args.out).exists() {
        println!("interrupted; the same command with --resume continues");
    }
    identified
}

/// Estimates the parameters, prints them and writes the model.
pub fn write_model(args: &Args, signals: &Signals) -> CommandResult {
    let first = open_log(&args.logs[0])?;
    let each = args.effects.iter().flatten().any(|effect| effect.ends_with("@each"));
    let tree =
        if each { Some(of_any_tree(args.model.as_deref())?) } else { tree_model(args.model.as_deref(), &first)? };
    if let Some(file) = tree {
        check_flags_of_tree(args)?;
        check_rate(&first, &args.logs[0], &[])?;
        let rows = args.rows.of(&first)?;
        return identify_tree::run(&file, &first, &rows, args.effects.as_deref(), &args.out, signals);
    }
    let effects = effects(args.effects.as_deref())?;
    let model = analytic_model(args.model.as_deref())?;
    let robot = model.robot_model().map_err(input)?;
    let (mut experiments, mut logs) = (Vec::new(), Vec::new());
    let mut opened = Some(first);
    for path in &args.logs {
        let log = opened.take().map_or_else(|| open_log(path), Ok)?;
        check_rate(&log, path, &effects)?;
        let rows = args.rows.of(&log)?;
        experiments.push(
            Experiment::new(&log, &robot, WindowConfig::IDENTIFICATION).map_err(input)?.filter_rows(|row| rows[row]),
        );
        logs.push((path, log, rows));
    }
    // Checked before the search, so that its result cannot be lost.
    let unwritable = |source| input(Unwritable { path: args.out.clone(), source });
    std::fs::OpenOptions::new().append(true).create(true).open(&args.out).map_err(unwritable)?;
    let mut simulator = simulator(&robot)?;
    let search = search_file(&args.out);
    let resume = if args.resume { Some(resumed(&search).map_err(input)?) } else { None };
    let start = args.start.as_deref().map(|path| analytic_model(Some(path))).transpose()?;
    let (generations, seed, force) = (args.generations, args.seed, args.force);
    let options = IdentifyOptions { generations, seed, force, resume, start };
    let bar = progress_bar(args.generations);
    let found = identify(&model, &effects, &experiments, &mut simulator, &options, &mut |stage, step, cost| {
        bar.set_message(match stage {
            Stage::Identifiability => "identifiability".to_owned(),
            Stage::GlobalSearch => format!("global search, cost {cost:.4e}"),
            Stage::Refinement => format!("refinement {step}, cost {cost:.4e}"),
            Stage::LocalSearch => format!("local search {step}, cost {cost:.4e}"),
        });
        if stage == Stage::GlobalSearch {
            bar.set_position(step as u64);
        }
        !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    twinstep_files::write(&args.out, found.model.to_toml()).map_err(unwritable)?;
    match &found.checkpoint {
        Some(checkpoint) => {
            twinstep_files::write(&search, serde_json::to_string(checkpoint).map_err(other)?).map_err(unwritable)?;
        }
        None if search.exists() => std::fs::remove_file(&search).map_err(unwritable)?,
        None => {}
    }
    print!("{}", text(&found));
    let fitted = found.model.robot_model().map_err(other)?;
    for (path, log, rows) in &logs {
        let mut error = |robot| evaluate(log, robot, &mut simulator, |row| rows[row]).map(|found| found.q_rmse_rad);
        if let (Some(before), Some(after)) = (error(&robot).map_err(input)?, error(&fitted).map_err(input)?) {
            println!(
                "{}: closed-loop joint RMSE {before:.4} -> {after:.4} rad on the rows it was fitted to",
                path.display()
            );
        }
    }
    if found.checkpoint.is_some() { Err(Failure::Interrupted) } else { Ok(()) }
}

fn check_flags_of_tree(args: &Args) -> Result<(), Failure> {
    let flags = [
        ("--start", args.start.is_some(), "`--model`: its values are the start"),
        ("--resume", args.resume, "no search that takes long enough to resume"),
        ("--force", args.force, "an interval for every parameter, as wide as its prior if the log says nothing"),
        ("LOGS", args.logs.len() > 1, "one log with several segments"),
    ];
    match flags.into_iter().find(|(_, given, _)| *given) {
        Some((flag, _, instead)) => Err(input(FlagOfQuadrupeds { flag, instead })),
        None => Ok(()),
    }
}

/// Fails if the sensors of a log repeat, and were measured at a lower rate than an effect needs.
fn check_rate(log: &Log, path: &Path, effects: &[(&'static Effect, Scope)]) -> CommandResult {
    log.check_measurements_per_period()
        .map_err(|error| Failure::Input(miette::miette!("{}: {error}", path.display())))?;
    let mut slow: Vec<&str> =
        effects.iter().filter(|(effect, _)| log.is_too_slow_for(effect)).map(|(effect, _)| effect.name).collect();
    slow.dedup();
    if slow.is_empty() {
        return Ok(());
    }
    Err(Failure::Input(miette::miette!(
        "{}: not identifiable from sensors that were measured at {:.0} Hz: {}\n  leave them out of `--effects`, or record the sensors at \
         their own rate",
        path.display(),
        log.measured_hz().unwrap_or_default(),
        slow.join(", ")
    )))
}

/// Returns the effects that are requested of a quadruped, with their scopes.
fn effects(given: Option<&[String]>) -> Result<Vec<(&'static Effect, Scope)>, Failure> {
    let default: Vec<String> = DEFAULT_EFFECTS.split(',').map(str::to_owned).collect();
    let parsed = |text: &String| match text.parse() {
        Ok(EffectAtScope(effect, scope)) => Ok((effect, scope)),
        Err(cause) => Err(input(EffectsError(cause))),
    };
    given.unwrap_or(&default).iter().map(parsed).collect()
}

fn progress_bar(generations: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} generations, {per_sec}, ETA {eta}  {msg}");
    ProgressBar::new(generations as u64).with_style(style.expect("a template"))
}

/// Returns a table with one line per parameter, and the highly correlated pairs.
fn text(found: &Identification) -> String {
    let mut lines = vec![format!("{:<44}  {:>10}  95 % interval", "", "value")];
    for finding in &found.findings {
        let interval = finding.interval.map_or(String::new(), |[low, high]| format!("{low:.4} to {high:.4}"));
        let remark = match finding.verdict {
            EstimateStatus::Identified => "",
            EstimateStatus::AtBound => "at its bound: the true value may lie outside",
            EstimateStatus::NotIdentifiable => "not identifiable from this log; kept at its initial value",
        };
        let (name, value) = (finding.parameter.name(), finding.value);
        let line = format!("{name:<44}  {value:>10.4}  {interval:<22} {} {remark}", finding.parameter.unit);
        lines.push(line.trim_end().to_owned());
    }
    lines.extend(found.findings.iter().filter_map(reading));
    for (one, other, correlation, experiment) in &found.correlated {
        lines.push(format!("highly correlated: {one} and {other} (correlation {correlation:.2})"));
        lines.extend(experiment.map(|experiment| format!("    suggested experiment: {experiment}")));
    }
    lines.push(format!("residuals: {:.2} -> {:.2} times the noise (RMS)\n", found.rms[0], found.rms[1]));
    lines.join("\n")
}

/// Returns a log-Cholesky coordinate as mass or centre of mass. Returns `None` for other parameters.
fn reading(finding: &ParameterEstimate) -> Option<String> {
    let parameter = &finding.parameter;
    let (name, unit, convert): (_, _, fn(f64) -> f64) = match parameter.parameter_name.as_str() {
        "theta.0" => ("mass", "kg", |alpha| (2.0 * alpha).exp()),
        "theta.7" => ("centre of mass, x", "m", |t| t),
        "theta.8" => ("centre of mass, y", "m", |t| t),
        "theta.9" => ("centre of mass, z", "m", |t| t),
        _ => return None,
    };
    let [low, high] = finding.interval?.map(convert);
    Some(format!("{} of the {}: {:.4} {unit} ({low:.4} to {high:.4})", name, parameter.scope, convert(finding.value)))
}
