//! `twinstep play`: a motion file through a robot model, as a measured log.

use std::path::PathBuf;

use indicatif::ProgressBar;
use twinstep_ensemble::ActuatorNetworkRobot;
use twinstep_model::{BaseMount, Actuator, RobotModel};
use twinstep_logs::Log;
use twinstep_effects::ModelFile;
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};
use twinstep_identify::{RecordError, record};

use crate::exit::{Failure, CommandResult, Signals, input, other};
use crate::serve::engine;

/// Play a motion file through a robot model, and write what the robot did as a measured log.
///
/// A motion file is a log (data.csv, .csv.gz or .parquet, and meta.json beside it) with command columns only: `t` and
/// `q_cmd_<joint>`, and where wanted `dq_cmd_<joint>`, `tau_ff_<joint>`, `kp` and `kd`; gains may also stand in meta.json,
/// and are the model's where neither has them. Joints without a column hold the default pose. The row's command is in
/// force from its `t` to the next row's; rows come at the actuator's 200 Hz or a whole fraction of it.
///
/// Every segment, and every episode in it, starts with the robot at rest in its default pose: on its feet, or held 1 m
/// above the ground. Columns `q_*`, `dq_*`, `pos_*`, `quat_*`, `vel_*` and `gyro_*`, where the motion has them, say
/// otherwise by their first row.
///
/// The log has `q_*` and `dq_*` sampled at `t`, `tau_measured_*` as the mean from `t` to the next row (none in a part's
/// last), the commands, and with a floating base `pos_*`, `quat_*`, `vel_*`, `gyro_*` and `foot_force_*`.
///
/// Example: `twinstep play stance.csv --engine batch --physics-hz 1000 --out stance_played.parquet`
#[derive(clap::Args)]
pub struct Args {
    /// The motion: a data file, or a folder that holds one.
    motion: PathBuf,
    /// Model file of the robot; the ideal Go2 without.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Whether the trunk moves: floating or fixed; as meta.json says of each segment without.
    #[arg(long, value_parser = base)]
    base: Option<BaseMount>,
    /// Who integrates the equations of motion: rapier (the reference) or batch (the fast one); the server's default
    /// without.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Rate of the physics [Hz]; a multiple of the actuator's 200. Without: rapier 200, batch 1000.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Solver iterations a physics step. Without: rapier 2, batch 4.
    #[arg(long, value_name = "N")]
    solver_iterations: Option<u32>,
    /// The log to write: *.parquet, *.csv or *.csv.gz, or a folder, which gets data.parquet and meta.json.
    #[arg(long, value_name = "LOG")]
    out: PathBuf,
}

/// The log would replace the motion.
#[derive(Debug, thiserror::Error)]
#[error("`--out` = {} is the motion itself\n  name another file or folder", .0.display())]
struct SameFile(PathBuf);

/// Plays and writes.
pub fn run(args: &Args) -> CommandResult {
    if args.motion.canonicalize().is_ok_and(|motion| args.out.canonicalize().is_ok_and(|out| out == motion)) {
        return Err(input(SameFile(args.out.clone())));
    }
    let file = args.model.as_ref().map_or(Ok(ModelFile::default()), ModelFile::load).map_err(input)?;
    let learned = ActuatorNetworkRobot::load(&file).map_err(input)?;
    let robot = match &learned {
        Some(learned) => learned.robot.clone(),
        None => file.robot_model().map_err(input)?,
    };
    let actuators = || learned.as_ref().map(|learned| Box::new(learned.actuators(1, false)) as Box<dyn Actuator>);
    let config = args.config();
    config.check(&robot.control).map_err(input)?;
    let motion = Log::open_commands(&args.motion).map_err(input)?;
    let signals = Signals::listen()?;
    let bar = ProgressBar::new(motion.rows() as u64);
    let played = play(&motion, &robot, &actuators, config, args.base, &mut |row| {
        bar.set_position(row as u64);
        !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    let log = played.map_err(|error| match error {
        RecordError::Interrupted => Failure::Interrupted,
        RecordError::Failed(_) | RecordError::Log(_) => other(error),
        RecordError::Motion(_) | RecordError::Backend(_) => input(error),
    })?;
    log.write(&args.out).map_err(input)
}

impl Args {
    fn config(&self) -> SimConfig {
        let default = SimConfig { threads: 1, ..SimConfig::default() };
        SimConfig {
            engine: self.engine.unwrap_or(default.engine),
            physics_hz: self.physics_hz,
            solver_iterations: self.solver_iterations,
            ..default
        }
    }
}

fn base(text: &str) -> Result<BaseMount, String> {
    match text {
        "floating" => Ok(BaseMount::Floating),
        "fixed" => Ok(BaseMount::Fixed),
        _ => Err("the base is floating or fixed".to_owned()),
    }
}

/// What the robot does when it is commanded as `motion` has it; `base` goes before that of the segments. `actuators` makes
/// the actuators of one robot, if they are not its own.
///
/// `progress` receives the number of rows done, and may end it.
pub fn play(
    motion: &Log,
    robot: &RobotModel,
    actuators: &dyn Fn() -> Option<Box<dyn Actuator>>,
    config: SimConfig,
    base: Option<BaseMount>,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Log, RecordError> {
    let based = |base| SimConfig { base: simulated(base), ..config };
    let source = source(robot, config);
    let failed = |error: twinstep_sim::BackendBuildError| RecordError::Backend(Box::new(error));
    match config.engine {
        Engine::Rapier => record(
            motion,
            robot,
            base,
            |base| {
                let backend = RapierBackend::new(robot.clone(), based(base), 1).map_err(failed)?;
                Ok(if let Some(actuators) = actuators() { backend.with_actuator(actuators) } else { backend })
            },
            source,
            progress,
        ),
        Engine::Batch => record(
            motion,
            robot,
            base,
            |base| {
                let backend = BatchBackend::new(robot.clone(), based(base), 1).map_err(failed)?;
                Ok(if let Some(actuators) = actuators() { backend.with_actuator(actuators) } else { backend })
            },
            source,
            progress,
        ),
    }
}

fn simulated(base: BaseMount) -> BaseMount {
    match base {
        BaseMount::Fixed => BaseMount::Fixed,
        BaseMount::Floating => BaseMount::Floating,
    }
}

fn source(robot: &RobotModel, config: SimConfig) -> String {
    let (physics_hz, solver_iterations) = (config.physics_hz(), config.solver_iterations());
    let engine = match config.engine {
        Engine::Rapier => "rapier",
        Engine::Batch => "batch",
    };
    format!("twinstep play: `{}` simulated by {engine} at {physics_hz} Hz x {solver_iterations}", robot.name)
}
