//! `twinstep evaluate`: measures the error of a robot model on a log.

use std::path::PathBuf;

use twinstep_identify::Evaluation;
use twinstep_workflows::{EvaluateOptions, Observer, RowSelection, evaluate};

use crate::exit::{CommandResult, other};

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

impl Rows {
    /// Returns the rows that are selected.
    pub fn selection(&self) -> RowSelection {
        RowSelection { from_s: self.from, until_s: self.until, segments: self.segment.clone() }
    }
}

/// Evaluates the model and prints its errors.
pub fn run(args: &Args) -> CommandResult {
    let options = EvaluateOptions {
        log: args.log.clone(),
        model: args.model.clone(),
        rows: args.rows.selection(),
        plot: args.plot.clone(),
    };
    let evaluation = evaluate(&options, &Observer::terminal()?)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&evaluation).map_err(other)?);
    } else {
        print!("{}", table(&evaluation));
    }
    Ok(())
}

/// Returns a table of the errors with one line per joint and one over all joints.
fn table(evaluation: &Evaluation) -> String {
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
