//! Diagnosis: which effects a robot model lacks.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_diagnose::{
    Cause, DiagnoseError, Diagnosis, DiagnosisOutput, TreeDiagnosis, diagnose as search_causes, diagnose_tree,
};
use twinstep_effects::{Effect, ModelFile, Scope, TreeModelFile};
use twinstep_logs::replay::check_gains;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::Joint;
use twinstep_report::report_data::{LogFacts, Provenance, ReportData};
use twinstep_report::write_report;
use twinstep_sim::BatchRollout;

use crate::date::today;
use crate::diagnosis_text;
use crate::failure::{Failure, input, other};
use crate::learned_residual::{self, LearnedTorque};
use crate::log_motion;
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::robot_file::{SimulatedRobot, analytic_model, simulator};
use crate::tree_model::{actuator_hz, tree_model};

/// Settings of [`diagnose`].
#[derive(Clone, Debug)]
pub struct DiagnoseOptions {
    /// Logs of one robot: data files, or folders that contain one.
    pub logs: Vec<PathBuf>,
    /// Model file to correct, or a robot file (URDF, MJCF). `None`: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Folder to write.
    pub out: PathBuf,
}

/// Result of [`diagnose`], also in the files of its folder.
pub struct Diagnosed {
    /// Causes, errors before and after, and what is not explained: `findings.json`.
    pub diagnosis: Diagnosis,
    /// `report.html`, if there is one.
    pub report: Option<PathBuf>,
    /// Pages of the robot with the simulation of the given and of the corrected model.
    pub motions: Vec<PathBuf>,
    /// Summary for a terminal.
    pub text: String,
    /// Why each cause was added, changed or removed, and why every other effect is no cause.
    pub why: String,
}

/// Folder of the proposed experiment, in the output folder.
const NEXT_EXPERIMENT: &str = "next_experiment";

/// Pages of the robot and its simulation with the given and with the corrected model, in the output folder.
const MOTIONS: [&str; 2] = ["motion_before.html", "motion_after.html"];
/// Length of their motion [s].
const MOTION_S: f64 = 20.0;

/// The output folder cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
struct Unwritable {
    path: PathBuf,
    source: std::io::Error,
}

/// A log has only positions, and nothing says which robot it is.
#[derive(Debug, thiserror::Error)]
#[error(
    "the log has no torques, and `{joint}` is no joint of a Go2\n  give the robot's file with --model: positions are compared \
     with a simulation of the robot"
)]
struct NoRobot {
    joint: String,
}

/// Finds the effects of the catalogue that a robot model lacks, and writes report, findings and corrected model.
///
/// ```no_run
/// use twinstep_workflows::{DiagnoseOptions, Observer, diagnose};
///
/// let options = DiagnoseOptions::new(vec!["data/go2_air_chirp".into()], "diagnosis");
/// for cause in diagnose(&options, &Observer::silent())?.diagnosis.findings {
///     println!("{} at {}", cause.effect, cause.scope);
/// }
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn diagnose(options: &DiagnoseOptions, observer: &Observer) -> Result<Diagnosed, Failure> {
    let logs = options.logs.iter().map(|path| open_log(path, observer)).collect::<Result<Vec<_>, _>>()?;
    if logs.is_empty() {
        return Err(Failure::Input(miette::miette!("`logs` is empty: at least one is needed")));
    }
    // Checked before the search, so that its result cannot be lost.
    std::fs::create_dir_all(&options.out).map_err(|source| input(Unwritable { path: options.out.clone(), source }))?;
    match robot_of_tree(options, &logs)? {
        Some(tree) => of_tree(options, &logs, tree, observer),
        None => of_quadruped(options, &logs, observer),
    }
}

impl DiagnoseOptions {
    /// Returns the options that diagnose logs against the ideal Go2.
    pub fn new(logs: Vec<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self { logs, model: None, out: out.into() }
    }
}

fn of_quadruped(options: &DiagnoseOptions, logs: &[Log], observer: &Observer) -> Result<Diagnosed, Failure> {
    let model = analytic_model(options.model.as_deref())?;
    let robot = model.robot_model().map_err(input)?;
    let mut simulator = simulator(&robot)?;
    let (output, learned) = with_progress(observer, |progress, stop| {
        let output = search_causes(logs, &model, &mut simulator, &stop, progress).map_err(failure)?;
        // What was found must not be lost with the networks.
        let learned = match learned_residual::learn(logs, &output, progress) {
            Err(Failure::Input(error) | Failure::Other(error)) => {
                observer.note(format_args!("note: the torque that no cause explains was not learned: {error}"));
                None
            }
            learned => learned?,
        };
        Ok((output, learned))
    })?;
    let DiagnosisOutput { mut diagnosis, extended: laws, next, .. } = output;
    diagnosis.extended_model = "extended.toml".to_owned();
    let motion = options.out.join(NEXT_EXPERIMENT);
    // The folder of an earlier diagnosis must not be mistaken for the result of this one.
    if motion.exists() {
        std::fs::remove_dir_all(&motion).map_err(|source| input(Unwritable { path: motion.clone(), source }))?;
    }
    if let Some((entry, next)) = diagnosis.next_experiment.as_mut().zip(next) {
        next.motion.write(&motion).map_err(input)?;
        NEXT_EXPERIMENT.clone_into(&mut entry.motion);
    }
    let corrected = write_model(options, &mut diagnosis, &laws, learned)?;
    let motions = motion_pages(options, &logs[0], SimulatedRobot::analytic(robot)?, corrected)?;
    let report = write_page(options, logs, (&model, &laws), &diagnosis, (&motions, &mut simulator))?;
    let motions = motions.iter().map(|motion| options.out.join(motion)).collect();
    let text = write_findings(options, &diagnosis)?;
    let why = diagnosis_text::why(&diagnosis);
    Ok(Diagnosed { diagnosis, report: Some(report), motions, text, why })
}

/// Writes the corrected model, with the networks if there are any. Returns its simulated robot.
fn write_model(
    options: &DiagnoseOptions,
    diagnosis: &mut Diagnosis,
    laws: &ModelFile,
    learned: Option<LearnedTorque>,
) -> Result<SimulatedRobot, Failure> {
    // The networks of an earlier diagnosis must not be mistaken for the result of this one.
    let networks = options.out.join(learned_residual::FILE);
    let _ = std::fs::remove_file(&networks);
    let mut extended = laws.clone();
    let corrected = match &learned {
        Some(learned) => {
            diagnosis.extended = learned.summary.after;
            diagnosis.learned_residual = Some(learned.summary.clone());
            extended.actuator = Some(learned_residual::settings(learned_residual::FILE.into()));
            learned.ensemble.write(networks).map_err(other)?;
            learned_residual::simulated(laws, learned)?
        }
        None => SimulatedRobot::analytic(laws.robot_model().map_err(input)?)?,
    };
    write_file(options, "extended.toml", &extended.to_toml())?;
    Ok(corrected)
}

/// Writes `report.html`.
fn write_page(
    options: &DiagnoseOptions,
    logs: &[Log],
    (model, laws): (&ModelFile, &ModelFile),
    diagnosis: &Diagnosis,
    (motions, simulator): (&[String], &mut BatchRollout),
) -> Result<PathBuf, Failure> {
    let facts = options.logs.iter().zip(logs).map(|(path, log)| LogFacts::of(&path.display().to_string(), log));
    let provenance = Provenance {
        command: std::env::args().collect::<Vec<_>>().join(" "),
        date: today(),
        model: options.model.as_ref().map_or("the ideal go2".to_owned(), |path| path.display().to_string()),
        logs: facts.collect(),
        motions: motions.to_vec(),
    };
    let name = |cause: &Cause| Effect::named(&cause.effect).zip(cause.scope.parse().ok());
    let causes: Vec<(&Effect, Scope)> = diagnosis.findings.iter().filter_map(name).collect();
    let data = ReportData::gather(&logs[0], model, laws, &causes, simulator, provenance).map_err(other)?;
    let report = options.out.join("report.html");
    write_report(diagnosis, &data, &report).map_err(input)?;
    Ok(report)
}

/// Returns the robot if it is not like the Go2, or its gains are not known.
fn robot_of_tree(options: &DiagnoseOptions, logs: &[Log]) -> Result<Option<TreeModelFile>, Failure> {
    let is_other = logs[0].joints().iter().any(|name| name.parse::<Joint>().is_err());
    if options.model.is_some() || !is_other {
        return tree_model(options.model.as_deref(), &logs[0]);
    }
    for log in logs {
        check_gains(log).map_err(input)?;
    }
    let largest = |joint: &String| {
        let torques = logs.iter().filter_map(|log| log.tau_measured(joint)).flatten();
        let largest = torques.filter(|torque| torque.is_finite()).fold(0.0_f64, |most, torque| most.max(torque.abs()));
        (joint.clone(), 2.0 * largest)
    };
    if logs[0].meta().tau_sensor == TorqueSensor::None {
        return Err(input(NoRobot { joint: logs[0].joints()[0].clone() }));
    }
    Ok(Some(TreeModelFile::of_drives(&logs[0].joints().iter().map(largest).collect::<Vec<_>>())))
}

/// Diagnoses a robot of any tree, and writes findings and corrected model.
fn of_tree(
    options: &DiagnoseOptions,
    logs: &[Log],
    file: TreeModelFile,
    observer: &Observer,
) -> Result<Diagnosed, Failure> {
    let rate = actuator_hz(&file);
    let found =
        with_progress(observer, |progress, stop| diagnose_tree(logs, &file, rate, &stop, progress).map_err(failure))?;
    let TreeDiagnosis { mut diagnosis, extended } = found;
    // Drives without a robot have no model file.
    if options.model.is_some() || file.robot == TreeModelFile::go2().robot {
        diagnosis.extended_model = "extended.toml".to_owned();
        write_file(options, "extended.toml", &extended.to_toml())?;
    }
    let text = write_findings(options, &diagnosis)?;
    let why = diagnosis_text::why(&diagnosis);
    Ok(Diagnosed { diagnosis, report: None, motions: Vec::new(), text, why })
}

/// Writes the pages of the robot and its simulation with both models. Returns their names: none if the log cannot be played.
fn motion_pages(
    options: &DiagnoseOptions,
    log: &Log,
    given: SimulatedRobot,
    extended: SimulatedRobot,
) -> Result<Vec<String>, Failure> {
    let mut written = Vec::new();
    for (file, robot) in MOTIONS.into_iter().zip(vec![given, extended]) {
        let title = format!("{} and {file}", options.logs[0].display());
        match log_motion::page_with_ghost(log.clone(), title, robot, MOTION_S) {
            Ok(page) => {
                write_file(options, file, &page)?;
                written.push(file.to_owned());
            }
            // The page of an earlier diagnosis must not be mistaken for the result of this one.
            Err(_) => drop(std::fs::remove_file(options.out.join(file))),
        }
    }
    Ok(written)
}

/// Runs a search with a spinner. An interruption ends it.
fn with_progress<T>(
    observer: &Observer,
    search: impl FnOnce(&mut dyn FnMut(&str) -> bool, Arc<AtomicBool>) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let bar = observer.spinner("{spinner} {elapsed} {msg}");
    let mut progress = |text: &str| {
        bar.set_message(text.to_owned());
        bar.tick();
        !observer.check().unwrap_or(true)
    };
    let found = search(&mut progress, observer.flag());
    bar.finish_and_clear();
    found
}

fn failure(error: DiagnoseError) -> Failure {
    match error {
        DiagnoseError::Interrupted => Failure::Interrupted,
        error => input(error),
    }
}

/// Writes `findings.json`, and returns a summary.
fn write_findings(options: &DiagnoseOptions, diagnosis: &Diagnosis) -> Result<String, Failure> {
    let json = serde_json::to_string_pretty(diagnosis).map_err(other)?;
    write_file(options, "findings.json", &json)?;
    Ok(diagnosis_text::text(diagnosis, &options.out))
}

/// Writes a file into the output folder.
fn write_file(options: &DiagnoseOptions, name: &str, text: &str) -> Result<(), Failure> {
    let path = options.out.join(name);
    twinstep_files::write(&path, text).map_err(|source| input(Unwritable { path, source }))
}
