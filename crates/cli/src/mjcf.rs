//! `twinstep mjcf`: exports the robot as a MuJoCo model.

use std::io::Write;
use std::path::{Path, PathBuf};

use twinstep_effects::is_robot_file;
use twinstep_env_server::is_of_tree;
use twinstep_model::{BaseMount, MjcfOptions, RobotTree, go2, mjcf};
use twinstep_robot_files::{QuadrupedNames, TreeMjcf, quadruped, read_robot, write_mjcf};
use twinstep_sim::effect_outside_mujoco;

use crate::exit::{CommandResult, Failure, input, other};
use twinstep_workflows::robot_file::robot_model;
use twinstep_workflows::tree_model::of_any_tree;

/// Allowed time steps [s].
const TIMESTEPS: std::ops::RangeInclusive<f64> = 1e-5..=0.02;

/// Export the robot as a MuJoCo model (MJCF, XML), to compare the physics with MuJoCo.
///
/// Any robot of a URDF or MJCF file can be exported. Notes say what the file has and the model does not. For a quadruped like the Go2
/// the model contains the kinematic tree, masses, inertias, armature, joint ranges and torque limits of the robot. Its
/// contacts are those of `--engine batch`: feet, both ends of each calf, and the corners of the base against the
/// ground. `ctrl` is torque [N·m] in the joint order FL, FR, RL, RR; hip, thigh, calf. The keyframe `default_pose` is
/// the initial state.
///
/// Example: `twinstep mjcf --out go2.xml && python -m mujoco.viewer --mjcf go2.xml`
#[derive(clap::Args)]
pub struct Args {
    /// Model file of the robot, or the name of one in this program, such as spot (docs/robots.md). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Mounting of the base: floating, or fixed; that of the Go2 1 m above the ground. A file can fix it, too.
    #[arg(long, default_value = "floating", value_parser = base)]
    base: BaseMount,
    /// Time step of the physics [s], 0.00001 to 0.02.
    #[arg(long, default_value_t = 0.001, value_name = "S")]
    timestep: f64,
    /// File to write. Default: stdout.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// `--timestep` is outside its range.
#[derive(Debug, thiserror::Error)]
#[error("`--timestep` = {0} is not allowed: {low} to {high} s", low = TIMESTEPS.start(), high = TIMESTEPS.end())]
struct TimestepError(f64);

/// The output file cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("`--out`: cannot write {}: {cause}", path.display())]
struct WriteError {
    path: PathBuf,
    cause: std::io::Error,
}

/// The robot file cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("`--model`: {}: {cause}", path.display())]
struct RobotError {
    path: PathBuf,
    cause: String,
}

/// Exports the model.
pub fn run(args: &Args) -> CommandResult {
    if !TIMESTEPS.contains(&args.timestep) {
        return Err(input(TimestepError(args.timestep)));
    }
    let options = MjcfOptions { base: args.base, timestep: args.timestep, ..MjcfOptions::default() };
    let text = match args.model.as_deref().filter(|path| is_robot_file(path)) {
        Some(path) => of_robot_file(path, &options)?,
        None => of_model_file(args.model.as_deref(), &options)?,
    };
    match &args.out {
        Some(path) => {
            twinstep_files::write(path, text).map_err(|cause| input(WriteError { path: path.clone(), cause }))
        }
        None => std::io::stdout().write_all(text.as_bytes()).map_err(other),
    }
}

/// Returns the model of a model file; as a tree if it is no quadruped like the Go2.
fn of_model_file(path: Option<&Path>, options: &MjcfOptions) -> Result<String, Failure> {
    if !path.is_some_and(is_of_tree) {
        return Ok(mjcf(&robot_model(path)?, options));
    }
    let robot = of_any_tree(path)?.tree_model().expect("the file was checked when it was read");
    if let Some(effect) = effect_outside_mujoco(&robot.joints) {
        eprintln!("note: `{effect}` of the model file is left out, because MuJoCo has no such joint");
    }
    Ok(of_tree(robot.plain_tree(), options))
}

fn of_tree(mut tree: RobotTree, options: &MjcfOptions) -> String {
    if options.base == BaseMount::Fixed {
        tree.base = Some(BaseMount::Fixed);
    }
    write_mjcf(&tree, &TreeMjcf { timestep: options.timestep, ..TreeMjcf::default() })
}

/// Returns the model of a robot file, as a tree if it has not the shape of the Go2. Prints what the file has and the model does not.
fn of_robot_file(path: &Path, options: &MjcfOptions) -> Result<String, Failure> {
    let failed = |cause: String| input(RobotError { path: path.to_owned(), cause });
    let text = std::fs::read_to_string(path).map_err(|cause| failed(cause.to_string()))?;
    let file = read_robot(&text, path.parent()).map_err(|cause| failed(cause.to_string()))?;
    let (text, notes) = match quadruped(&file, &QuadrupedNames::default(), go2().control) {
        Ok((robot, notes)) => (mjcf(&robot, options), notes),
        Err(why) => {
            let mut notes = file.notes.clone();
            notes.push(format!("exported with its own shapes, because it is no quadruped like the Go2: {why}"));
            (of_tree(file.tree, options), notes)
        }
    };
    for note in notes {
        eprintln!("note: {note}");
    }
    Ok(text)
}

fn base(text: &str) -> Result<BaseMount, String> {
    match text {
        "floating" => Ok(BaseMount::Floating),
        "fixed" => Ok(BaseMount::Fixed),
        _ => Err("must be `floating` or `fixed`".to_owned()),
    }
}
