//! Identification of model parameters from measured logs.

use std::path::{Path, PathBuf};

use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_identify::{
    DEFAULT_EFFECTS, EffectAtScope, EffectAtScopeError, Experiment, GlobalSearch, Identification,
    IdentifyOptions as SearchOptions, Stage, WindowConfig, evaluate, identify as search_parameters,
};
use twinstep_logs::Log;
use twinstep_sim::BatchRollout;

use crate::failure::{Failure, input, other};
use crate::identify_options::{Estimated, Fit, Identified, IdentifyOptions};
use crate::identify_report;
use crate::identify_tree::{self, Unwritable};
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::robot_file::{analytic_model, simulator};
use crate::tree_model::{of_any_tree, tree_model};

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

/// Estimates parameters from measured logs, and writes the model.
///
/// A robot that is not like the Go2 is fitted to one log, without a global search.
///
/// ```no_run
/// use twinstep_workflows::{IdentifyOptions, Observer, identify};
///
/// let options = IdentifyOptions {
///     logs: vec!["log".into()],
///     effects: Some(vec!["payload@base".to_owned(), "coulomb_friction@calf".to_owned()]),
///     ..IdentifyOptions::new("fitted.toml")
/// };
/// for estimate in identify(&options, &Observer::silent())?.estimates {
///     println!("{} = {} {}", estimate.name, estimate.value, estimate.unit);
/// }
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn identify(options: &IdentifyOptions, observer: &Observer) -> Result<Identified, Failure> {
    let Some(path) = options.logs.first() else {
        return Err(Failure::Input(miette::miette!("`logs` is empty: at least one is needed")));
    };
    let first = open_log(path, observer)?;
    let each = options.effects.iter().flatten().any(|effect| effect.ends_with("@each"));
    let model = options.model.as_deref();
    let tree = if each { Some(of_any_tree(model)?) } else { tree_model(model, &first)? };
    if let Some(file) = tree {
        check_flags_of_tree(options)?;
        check_rate(&first, path, &[])?;
        let rows = options.rows.of(&first)?;
        return identify_tree::run(&file, &first, &rows, options, observer);
    }
    let effects = effects(options.effects.as_deref())?;
    let model = analytic_model(model)?;
    let robot = model.robot_model().map_err(input)?;
    let (mut experiments, mut logs) = (Vec::new(), Vec::new());
    let mut opened = Some(first);
    for path in &options.logs {
        let log = opened.take().map_or_else(|| open_log(path, observer), Ok)?;
        check_rate(&log, path, &effects)?;
        let rows = options.rows.of(&log)?;
        experiments.push(
            Experiment::new(&log, &robot, WindowConfig::IDENTIFICATION).map_err(input)?.filter_rows(|row| rows[row]),
        );
        logs.push((path, log, rows));
    }
    // Checked before the search, so that its result cannot be lost.
    let unwritable = |source| input(Unwritable { path: options.out.clone(), source });
    std::fs::OpenOptions::new().append(true).create(true).open(&options.out).map_err(unwritable)?;
    let mut simulator = simulator(&robot)?;
    let search_options = search_options(options)?;
    let found = search(&model, &effects, &experiments, &mut simulator, &search_options, observer)?;
    twinstep_files::write(&options.out, found.model.to_toml()).map_err(unwritable)?;
    let search = search_file(&options.out);
    match &found.checkpoint {
        Some(checkpoint) => {
            twinstep_files::write(&search, serde_json::to_string(checkpoint).map_err(other)?).map_err(unwritable)?;
        }
        None if search.exists() => std::fs::remove_file(&search).map_err(unwritable)?,
        None => {}
    }
    let fitted = found.model.robot_model().map_err(other)?;
    let mut fits = Vec::new();
    // An interrupted search leaves no time for simulations.
    for (path, log, rows) in logs.iter().filter(|_| found.checkpoint.is_none()) {
        let mut error = |robot| evaluate(log, robot, &mut simulator, |row| rows[row]).ok()?.q_rmse_rad;
        if let (Some(before), Some(after)) = (error(&robot), error(&fitted)) {
            fits.push(Fit { log: (*path).clone(), q_rmse_rad: [before, after] });
        }
    }
    Ok(identified(&found, fits))
}

/// Searches the parameters, and shows how far it is.
fn search(
    model: &ModelFile,
    effects: &[(&'static Effect, Scope)],
    experiments: &[Experiment],
    simulator: &mut BatchRollout,
    options: &SearchOptions,
    observer: &Observer,
) -> Result<Identification, Failure> {
    let template = "{bar:30} {pos}/{len} generations, {per_sec}, ETA {eta}  {msg}";
    let bar = observer.bar(options.generations as u64, template);
    let found = search_parameters(model, effects, experiments, simulator, options, &mut |stage, step, cost| {
        bar.set_message(match stage {
            Stage::Identifiability => "identifiability".to_owned(),
            Stage::GlobalSearch => format!("global search, cost {cost:.4e}"),
            Stage::Refinement => format!("refinement {step}, cost {cost:.4e}"),
            Stage::LocalSearch => format!("local search {step}, cost {cost:.4e}"),
        });
        if stage == Stage::GlobalSearch {
            bar.set_position(step as u64);
        }
        !observer.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    found.map_err(input)
}

/// Returns the settings of the search, which continues an interrupted one if that is wanted.
fn search_options(options: &IdentifyOptions) -> Result<SearchOptions, Failure> {
    let resume = if options.resume { Some(resumed(&search_file(&options.out)).map_err(input)?) } else { None };
    let start = options.start.as_deref().map(|path| analytic_model(Some(path))).transpose()?;
    Ok(SearchOptions { generations: options.generations, seed: options.seed, force: options.force, resume, start })
}

fn identified(found: &Identification, fits: Vec<Fit>) -> Identified {
    let estimates = found.findings.iter().map(|finding| Estimated {
        name: finding.parameter.name(),
        unit: finding.parameter.unit.to_string(),
        value: finding.value,
        interval: finding.interval,
    });
    let table = identify_report::table(found);
    Identified { estimates: estimates.collect(), fits, table, is_interrupted: found.checkpoint.is_some() }
}

fn check_flags_of_tree(options: &IdentifyOptions) -> Result<(), Failure> {
    let flags = [
        ("--start", options.start.is_some(), "`--model`: its values are the start"),
        ("--resume", options.resume, "no search that takes long enough to resume"),
        ("--force", options.force, "an interval for every parameter, as wide as its prior if the log says nothing"),
        ("LOGS", options.logs.len() > 1, "one log with several segments"),
    ];
    match flags.into_iter().find(|(_, given, _)| *given) {
        Some((flag, _, instead)) => Err(input(FlagOfQuadrupeds { flag, instead })),
        None => Ok(()),
    }
}

/// Fails if the sensors of a log repeat, and were measured at a lower rate than an effect needs.
fn check_rate(log: &Log, path: &Path, effects: &[(&'static Effect, Scope)]) -> Result<(), Failure> {
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
