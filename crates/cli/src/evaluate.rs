//! `twinstep evaluate`: measures the error of a robot model on a log.

use std::path::{Path, PathBuf};

use twinstep_effects::TreeModelFile;
use twinstep_identify::{Evaluation, evaluate, position_errors};
use twinstep_inference::{Candidate, JointLog};
use twinstep_logs::Log;
use twinstep_model::JOINT_NAMES;

use crate::exit::{CommandResult, Failure, input, other};
use crate::open_log::open_log;
use crate::robot_file::SimulatedRobot;
use crate::tree_model::{actuator_hz, note_assumptions, tree_model};
use twinstep_report::evaluation_plot::Errors;
use twinstep_report::{chart, evaluation_plot};

/// Measure the error of a robot model on a measured log.
///
/// Torque: the model's actuators receive the measured positions and velocities and the log's commands. Their torque is
/// compared at the location of the log's torque sensor. Position: the log's commands are simulated in closed loop. With
/// a fixed base, each segment is simulated from its first measured state to its end. With a floating base, windows of
/// 0.5 s are simulated from measured states. If the model file has a table `[actuator]`, the mean of its networks is the
/// torque, or is added to that of the laws. Errors are root mean squares over all selected rows and joints.
///
/// A robot that is not like the Go2 (`--model arm.xml`, or a model file with `robot = "arm.xml"`) needs segments with a fixed base. Its
/// torque is that of the same simulation. Gains that the log does not state are those of `[control]`, or three times the torque
/// limit per radian. The columns have the names of the robot file's joints, or those of `[joints.rename]`.
///
/// Example: `twinstep evaluate --model extended.toml data/go2_air_chirp --plot errors.svg`
#[derive(clap::Args)]
pub struct Args {
    /// Measured log: a data file, or a folder that contains one.
    log: PathBuf,
    /// Model file of the robot, or the name of one in this program, such as spot (docs/robots.md). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    #[command(flatten)]
    rows: Rows,
    /// Print one JSON object and nothing else on stdout.
    #[arg(long)]
    json: bool,
    /// Write a plot: the error of each joint, and the joint with the largest position error over time.
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
}

/// Selection of rows by time.
#[derive(Default, clap::Args)]
pub struct Rows {
    /// Evaluate only rows from this time on [s].
    #[arg(long, value_name = "S")]
    from: Option<f64>,
    /// Evaluate only rows before this time [s].
    #[arg(long, value_name = "S")]
    until: Option<f64>,
    /// Evaluate only the segments with this name. Can be repeated.
    #[arg(long, value_name = "NAME")]
    segment: Vec<String>,
}

/// `--segment` is not a segment of the log.
#[derive(Debug, thiserror::Error)]
#[error("`--segment`: the log has no segment `{given}`; its segments are {segments}")]
struct NoSegment {
    given: String,
    segments: String,
}

/// `--from` and `--until` select no row.
#[derive(Debug, thiserror::Error)]
#[error("`--from`, `--until` and `--segment` select no row: `t` of the log is {first} to {last} s")]
struct NoRows {
    first: f64,
    last: f64,
}

impl Rows {
    /// Returns, for each row of the log, whether it is selected.
    pub fn of(&self, log: &Log) -> Result<Vec<bool>, Failure> {
        let (from, until) = (self.from.unwrap_or(f64::NEG_INFINITY), self.until.unwrap_or(f64::INFINITY));
        let segments: Vec<&str> = log.meta().segments.iter().map(|segment| segment.name.as_str()).collect();
        if let Some(given) = self.segment.iter().find(|given| !segments.contains(&given.as_str())) {
            return Err(input(NoSegment { given: given.clone(), segments: segments.join(", ") }));
        }
        let is_selected = |row: usize| {
            let name = segments[log.segment()[row] as usize];
            self.segment.is_empty() || self.segment.iter().any(|selected| selected == name)
        };
        let in_time = |row: usize| (from..until).contains(&log.t()[row]);
        let rows: Vec<bool> = (0..log.rows()).map(|row| in_time(row) && is_selected(row)).collect();
        if rows.contains(&true) {
            return Ok(rows);
        }
        let (first, last) = (log.t()[0], log.t()[log.rows() - 1]);
        Err(input(NoRows { first, last }))
    }
}

/// Evaluates the model and prints its errors.
pub fn run(args: &Args) -> CommandResult {
    let log = open_log(&args.log)?;
    let rows = args.rows.of(&log)?;
    if let Some(path) = &args.plot {
        chart::check_writable(path).map_err(input)?;
    }
    let (evaluation, errors) = match tree_model(args.model.as_deref(), &log)? {
        Some(file) => errors_of_tree(&file, &log, &rows)?,
        None => errors_of_quadruped(args, &log, &rows)?,
    };
    check_finite(&evaluation, &args.log)?;
    if let Some(path) = &args.plot {
        let model = args.model.as_ref().map_or("the ideal go2".to_owned(), |model| model.display().to_string());
        let title = format!("{model} on {}", args.log.display());
        evaluation_plot::write_svg(&log, &evaluation, &errors, &title, path).map_err(input)?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&evaluation).map_err(other)?);
    } else {
        print!("{}", table(&evaluation));
    }
    Ok(())
}

fn errors_of_tree(file: &TreeModelFile, log: &Log, rows: &[bool]) -> Result<(Evaluation, Errors), Failure> {
    let joint_log = JointLog::new(log, &file.nominal.tree, |row| rows[row]).map_err(input)?;
    note_assumptions(file, &joint_log);
    let candidate = Candidate::of(file).map_err(input)?;
    twinstep_inference::evaluate(&joint_log, &candidate, actuator_hz(file)).map_err(input)
}

fn errors_of_quadruped(args: &Args, log: &Log, rows: &[bool]) -> Result<(Evaluation, Errors), Failure> {
    let SimulatedRobot { robot, mut simulator } = SimulatedRobot::load(args.model.as_deref(), log, &args.log)?;
    let evaluation = evaluate(log, &robot, &mut simulator, |row| rows[row]).map_err(input)?;
    let errors = match args.plot {
        Some(_) => position_errors(log, &robot, &mut simulator, |row| rows[row]).map_err(input)?,
        None => Default::default(),
    };
    let names = JOINT_NAMES.map(str::to_owned);
    Ok((evaluation, names.into_iter().zip(errors).filter(|(_, errors)| !errors.is_empty()).collect()))
}

/// Fails if an error is not a number: the simulation diverges.
fn check_finite(evaluation: &Evaluation, log: &Path) -> CommandResult {
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

/// Returns a table of the errors with one line per joint and one over all joints.
pub fn table(evaluation: &Evaluation) -> String {
    let cell = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    let line = |name: &str, q: Option<f64>, torque: Option<f64>| {
        format!("{name:<10}  {:>10}  {:>12}\n", cell(q), cell(torque))
    };
    let mut text = "joint        q [rad]    torque [N·m]   (RMSE)\n".to_owned();
    for (name, joint) in &evaluation.per_joint {
        text += &line(name, joint.q_rmse_rad, joint.torque_rmse_nm);
    }
    text + &line("all joints", evaluation.q_rmse_rad, evaluation.torque_rmse_nm)
}
