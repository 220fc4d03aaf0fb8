//! `twinstep diagnose`: reports which effects a robot model lacks.

use std::path::PathBuf;

use twinstep_workflows::{DiagnoseOptions, Diagnosed, Observer, diagnose};

use crate::exit::{CommandResult, Failure, other};

/// Find the effects that a robot model lacks, estimate their parameters and write the corrected model.
///
/// Logs with motor currents are compared with the equations of drives, joints and base, without simulation. Causes are the effects of
/// the catalogue with the highest evidence, beside everything that each robot has a little of. findings.json has each decision. If no
/// effect of the catalogue is the cause, the report states what the residual depends on. If the log shows torques, or its base is
/// fixed, an ensemble of networks then learns the missing torque. It is kept if it reduces the error on held-out blocks by a fifth;
/// extended.toml adds it to the laws (`[actuator] mode = "residual"`).
///
/// Without motor currents the torques of the drives by their laws take their place. If the base is fixed, positions are compared
/// with simulations; that takes longer.
///
/// DIR gets report.html for a browser, findings.json for programs and extended.toml, the corrected model, which
/// `twinstep serve --model` loads. motion_before.html and motion_after.html play the first 20 s of the log, with the
/// simulation of the given and of the corrected model as the robot's ghost. If some causes are not distinguishable with this log, DIR also gets next_experiment,
/// the safe motion that discriminates between them best. Execute it with `twinstep play` or on the robot, then diagnose
/// both logs together.
///
/// For a robot that is not like the Go2, give its URDF, MJCF or model file with --model: DIR gets findings.json and extended.toml.
/// Torques may be those of motors or at the output. Without torques, the base must be fixed: positions are compared. Gains that no
/// file states are estimated first. Without --model only the drives are compared: that needs torques.
///
/// Example: `twinstep diagnose data/go2_air_chirp --out diagnosis`
#[derive(clap::Args)]
pub struct Args {
    /// Logs of one robot: data files, or folders that contain one.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Model file to correct, or a robot file (URDF, MJCF). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print findings.json to stdout too, and nothing else.
    #[arg(long)]
    json: bool,
    /// Print why each cause was added, changed or removed, and why every other effect of the catalogue is no cause.
    #[arg(long, conflicts_with = "json")]
    explain: bool,
}

/// Diagnoses the logs, writes the output folder and prints a summary.
pub fn run(args: &Args) -> CommandResult {
    let options = DiagnoseOptions { model: args.model.clone(), ..DiagnoseOptions::new(args.logs.clone(), &args.out) };
    let found = diagnose_and_print(&options, args.json)?;
    if args.explain {
        print!("{}", found.why);
    }
    Ok(())
}

/// Diagnoses logs and prints a summary, or the findings as JSON.
pub fn diagnose_and_print(options: &DiagnoseOptions, json: bool) -> Result<Diagnosed, Failure> {
    let found = diagnose(options, &Observer::terminal()?)?;
    if json {
        println!("{}", serde_json::to_string_pretty(&found.diagnosis).map_err(other)?);
        return Ok(found);
    }
    print!("{}", found.text);
    if let Some(report) = &found.report {
        println!("report: {}", report.display());
    }
    for motion in &found.motions {
        println!("robot and simulation: {}", motion.display());
    }
    Ok(found)
}
