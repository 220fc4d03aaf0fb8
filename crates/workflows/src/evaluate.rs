//! Error of a robot model on a measured log.

use std::path::{Path, PathBuf};

use twinstep_effects::TreeModelFile;
use twinstep_identify::{Evaluation, evaluate as evaluate_quadruped, position_errors};
use twinstep_inference::{Candidate, JointLog};
use twinstep_logs::Log;
use twinstep_model::JOINT_NAMES;
use twinstep_report::evaluation_plot::Errors;
use twinstep_report::{chart, evaluation_plot};

use crate::failure::{Failure, input};
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::robot_file::SimulatedRobot;
use crate::rows::RowSelection;
use crate::tree_model::{actuator_hz, note_assumptions, tree_model};

/// Settings of [`evaluate`].
#[derive(Clone, Debug)]
pub struct EvaluateOptions {
    /// Measured log: a data file, or a folder that contains one.
    pub log: PathBuf,
    /// Model file of the robot, or the name of one in this program. `None`: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Rows that are compared.
    pub rows: RowSelection,
    /// Plot of the errors to write (SVG).
    pub plot: Option<PathBuf>,
}

/// Measures the errors of torque and position of a robot model on a measured log.
///
/// ```no_run
/// use twinstep_workflows::{EvaluateOptions, Observer, evaluate};
///
/// let options = EvaluateOptions { model: Some("extended.toml".into()), ..EvaluateOptions::new("log") };
/// println!("{:?} rad", evaluate(&options, &Observer::silent())?.q_rmse_rad);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn evaluate(options: &EvaluateOptions, observer: &Observer) -> Result<Evaluation, Failure> {
    let log = open_log(&options.log, observer)?;
    let rows = options.rows.of(&log)?;
    if let Some(path) = &options.plot {
        chart::check_writable(path).map_err(input)?;
    }
    let (evaluation, errors) = match tree_model(options.model.as_deref(), &log)? {
        Some(file) => errors_of_tree(&file, &log, &rows, observer)?,
        None => errors_of_quadruped(options, &log, &rows)?,
    };
    check_finite(&evaluation, &options.log)?;
    if let Some(path) = &options.plot {
        let model = options.model.as_ref().map_or("the ideal go2".to_owned(), |model| model.display().to_string());
        let title = format!("{model} on {}", options.log.display());
        evaluation_plot::write_svg(&log, &evaluation, &errors, &title, path).map_err(input)?;
    }
    Ok(evaluation)
}

impl EvaluateOptions {
    /// Returns the options of the ideal Go2 on all rows of a log.
    pub fn new(log: impl Into<PathBuf>) -> Self {
        Self { log: log.into(), model: None, rows: RowSelection::default(), plot: None }
    }
}

fn errors_of_tree(
    file: &TreeModelFile,
    log: &Log,
    rows: &[bool],
    observer: &Observer,
) -> Result<(Evaluation, Errors), Failure> {
    let joint_log = JointLog::new(log, &file.nominal.tree, |row| rows[row]).map_err(input)?;
    note_assumptions(file, &joint_log, observer);
    let candidate = Candidate::of(file).map_err(input)?;
    twinstep_inference::evaluate(&joint_log, &candidate, actuator_hz(file)).map_err(input)
}

fn errors_of_quadruped(options: &EvaluateOptions, log: &Log, rows: &[bool]) -> Result<(Evaluation, Errors), Failure> {
    let SimulatedRobot { robot, mut simulator } = SimulatedRobot::load(options.model.as_deref(), log, &options.log)?;
    let evaluation = evaluate_quadruped(log, &robot, &mut simulator, |row| rows[row]).map_err(input)?;
    let errors = match options.plot {
        Some(_) => position_errors(log, &robot, &mut simulator, |row| rows[row]).map_err(input)?,
        None => Default::default(),
    };
    let names = JOINT_NAMES.map(str::to_owned);
    Ok((evaluation, names.into_iter().zip(errors).filter(|(_, errors)| !errors.is_empty()).collect()))
}

/// Fails if an error is not a number: the simulation diverges.
fn check_finite(evaluation: &Evaluation, log: &Path) -> Result<(), Failure> {
    let all =
        (evaluation.per_joint.iter()).map(|(name, joint)| (name.as_str(), [joint.q_rmse_rad, joint.torque_rmse_nm]));
    let is_number = |value: &Option<f64>| value.is_none_or(f64::is_finite);
    match all.into_iter().find(|(_, values)| !values.iter().all(is_number)) {
        Some((joint, _)) => Err(Failure::Other(miette::miette!(
            "{}: the simulation of this model diverges at {joint}: start from a model that does not, and see `twinstep log` for what \
             is wrong with the log",
            log.display()
        ))),
        None => Ok(()),
    }
}
