//! `twinstep identify`: numbers for a model from measured logs.

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_logs::Log;
use twinstep_effects::ModelFile;
use twinstep_identify::{DEFAULT_EFFECTS, EffectAtScope, Experiment, ParameterEstimate, WindowConfig, Identification, IdentifyOptions, GlobalSearch, Stage, EstimateStatus, evaluate, identify};

use crate::evaluate::{Rows, simulator};
use crate::exit::{Failure, CommandResult, Signals, input, other};


/// Find the numbers of effects from measured logs (SPI: sampling-based parameter identification).
///
/// Simulations of the log's commands, thousands of candidates in the lanes of the batch engine, are compared with what was
/// measured, each channel in units of its noise: CMA-ES finds the valley, Gauss-Newton its bottom. Every number comes with
/// a 95 % interval. First it is predicted what this log can tell; what it cannot is left where it is and said, unless
/// --force is given. Numbers that cannot be told apart are named, with the experiment that would.
///
/// The model that is written loads in `twinstep serve --model` and `twinstep evaluate --model`. Ctrl-C ends the search and
/// writes the best so far, and beside it OUT.search.json, from which the same command with --resume goes on.
///
/// Example: `twinstep identify data/go2_air_chirp --until 10 --out fitted.toml`
#[derive(clap::Args)]
pub struct Args {
    /// The logs: data files, or folders that hold one; with the base held, free, or parts of both.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// The model to start from; the ideal Go2 without.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// What to seek: effects with scopes, as in `coulomb_friction@calf,payload@base`; `twinstep effects` lists them.
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = DEFAULT_EFFECTS, hide_default_value = true)]
    effects: Vec<EffectAtScope>,
    #[command(flatten)]
    rows: Rows,
    /// Seek also what the log cannot tell.
    #[arg(long)]
    force: bool,
    /// Most generations of the search.
    #[arg(long, value_name = "N", default_value_t = IdentifyOptions::default().generations)]
    generations: usize,
    /// Seed of the search.
    #[arg(long, default_value_t = IdentifyOptions::default().seed)]
    seed: u64,
    /// Go on with the search that Ctrl-C ended, from OUT.search.json.
    #[arg(long)]
    resume: bool,
    /// The model file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// The file cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
struct Unwritable {
    path: PathBuf,
    source: std::io::Error,
}

/// There is no search to go on with.
#[derive(Debug, thiserror::Error)]
#[error("cannot resume from {}: {cause}\n  without --resume the search starts anew", path.display())]
struct NotResumable {
    path: PathBuf,
    cause: String,
}

/// Where an ended search is kept.
fn search_file(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".search.json");
    name.into()
}

fn resumed(path: &Path) -> Result<GlobalSearch, NotResumable> {
    let failed = |cause: String| NotResumable { path: path.to_owned(), cause };
    let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
    serde_json::from_str(&text).map_err(|error| failed(error.to_string()))
}

/// Identifies, prints and writes.
pub fn run(args: &Args) -> CommandResult {
    let model = args.model.as_ref().map_or(Ok(ModelFile::default()), ModelFile::load_without_actuator_network).map_err(input)?;
    let robot = model.robot_model().map_err(input)?;
    let (mut experiments, mut logs) = (Vec::new(), Vec::new());
    for path in &args.logs {
        let log = Log::open(path).map_err(input)?;
        let rows = args.rows.of(&log)?;
        experiments.push(Experiment::new(&log, &robot, WindowConfig::IDENTIFICATION).map_err(input)?.filter_rows(|row| rows[row]));
        logs.push((path, log, rows));
    }
    // Before the search, not after it: what it finds must not be lost.
    let unwritable = |source| input(Unwritable { path: args.out.clone(), source });
    std::fs::OpenOptions::new().append(true).create(true).open(&args.out).map_err(unwritable)?;
    let signals = Signals::listen()?;
    let mut simulator = simulator(&robot)?;
    let effects: Vec<_> = args.effects.iter().map(|EffectAtScope(effect, scope)| (*effect, *scope)).collect();
    let search = search_file(&args.out);
    let resume = if args.resume { Some(resumed(&search).map_err(input)?) } else { None };
    let options = IdentifyOptions { generations: args.generations, seed: args.seed, force: args.force, resume };
    let bar = progress_bar(args.generations);
    let found = identify(&model, &effects, &experiments, &mut simulator, &options, &mut |stage, step, cost| {
        bar.set_message(match stage {
            Stage::Identifiability => "what the log can tell".to_owned(),
            Stage::GlobalSearch => format!("search, cost {cost:.4e}"),
            Stage::Refinement => format!("refine {step}, cost {cost:.4e}"),
        });
        if stage == Stage::GlobalSearch {
            bar.set_position(step as u64);
        }
        !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    std::fs::write(&args.out, found.model.to_toml()).map_err(unwritable)?;
    match &found.checkpoint {
        Some(ended) => std::fs::write(&search, serde_json::to_string(ended).map_err(other)?).map_err(unwritable)?,
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
    println!("written to {}; judge it on rows it has not seen: twinstep evaluate --model", args.out.display());
    if found.checkpoint.is_some() {
        println!("ended before it was done; the same command with --resume goes on");
        return Err(Failure::Interrupted);
    }
    Ok(())
}

fn progress_bar(generations: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} generations, {per_sec}, ETA {eta}  {msg}");
    ProgressBar::new(generations as u64).with_style(style.expect("a template"))
}

/// A line an unknown, and what cannot be told apart.
fn text(found: &Identification) -> String {
    let mut lines = vec![format!("{:<44}  {:>10}  95 % interval", "", "value")];
    for finding in &found.findings {
        let interval = finding.interval.map_or(String::new(), |[low, high]| format!("{low:.4} to {high:.4}"));
        let remark = match finding.verdict {
            EstimateStatus::Identified => "",
            EstimateStatus::AtBound => "at its bound: the truth may lie beyond",
            EstimateStatus::NotIdentifiable => "this log cannot tell: left as it was",
        };
        let (name, value) = (finding.parameter.name(), finding.value);
        let line = format!("{name:<44}  {value:>10.4}  {interval:<22} {} {remark}", finding.parameter.unit);
        lines.push(line.trim_end().to_owned());
    }
    lines.extend(found.findings.iter().filter_map(reading));
    for (one, other, correlation, experiment) in &found.correlated {
        lines.push(format!("cannot be told apart: {one} and {other} (correlation {correlation:.2})"));
        lines.extend(experiment.map(|experiment| format!("    what would: {experiment}")));
    }
    lines.push(format!("residuals: {:.2} -> {:.2} times the noise (RMS)\n", found.rms[0], found.rms[1]));
    lines.join("\n")
}

/// What people call a log-Cholesky coordinate, where they have a name for it.
fn reading(finding: &ParameterEstimate) -> Option<String> {
    let unknown = &finding.parameter;
    let (name, unit, convert): (_, _, fn(f64) -> f64) = match unknown.parameter_name.as_str() {
        "theta.0" => ("mass", "kg", |alpha| (2.0 * alpha).exp()),
        "theta.7" => ("centre of mass, x", "m", |t| t),
        "theta.8" => ("centre of mass, y", "m", |t| t),
        "theta.9" => ("centre of mass, z", "m", |t| t),
        _ => return None,
    };
    let [low, high] = finding.interval?.map(convert);
    Some(format!("{} of the {}: {:.4} {unit} ({low:.4} to {high:.4})", name, unknown.scope, convert(finding.value)))
}
