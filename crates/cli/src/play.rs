//! `twinstep play`: simulates a motion file with a robot model and writes a measured log.

use std::path::PathBuf;

use indicatif::ProgressBar;
use twinstep_effects::ModelFile;
use twinstep_ensemble::ActuatorNetworkRobot;
use twinstep_identify::{RecordError, record};
use twinstep_logs::Log;
use twinstep_logs::replay::at_log_rate;
use twinstep_model::{Actuator, BaseMount, RobotModel};
use twinstep_sim::{BatchBackend, Engine, MujocoBackend, MujocoPlant, RapierBackend, SimConfig};
use twinstep_workflows::progress_lines;

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::serve::engine;

/// Simulate a motion file with a robot model and write the result as a measured log.
///
/// A motion file is a log (data.csv, .csv.gz or .parquet, with meta.json in the same folder) with command columns only.
/// `t` and `q_cmd_<joint>` are required; `dq_cmd_<joint>`, `tau_ff_<joint>`, `kp` and `kd` are optional. Gains may also
/// be in meta.json. Default: the gains of the model. Joints without a column hold the default pose. A row's command is
/// in force from its `t` to the next row's. The rate of the rows is 20 to 2000 Hz. A motion of 200 Hz or more is
/// simulated with actuators at its own rate, a slower one at the smallest multiple of its rate that is at least 200 Hz.
///
/// Every segment, and every episode in it, starts with the robot at rest in its default pose: standing, or fixed 1 m
/// above the ground. If the motion has columns `q_*`, `dq_*`, `pos_*`, `quat_*`, `vel_*` or `gyro_*`, their first row
/// is the initial state instead.
///
/// The log has `q_*` and `dq_*` sampled at `t`, the commands, and `tau_measured_*` as the mean from `t` to the next
/// row. The last row of each segment and episode has no torque. With a floating base the log also has `pos_*`,
/// `quat_*`, `vel_*`, `gyro_*` and `foot_force_*`.
///
/// Example: `twinstep play stance.csv --engine batch --physics-hz 1000 --out stance_played.parquet`
#[derive(clap::Args)]
pub struct Args {
    /// Motion file, or a folder that contains one.
    motion: PathBuf,
    /// Model file of the robot. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Mounting of the base: floating or fixed. Default: that of each segment in meta.json.
    #[arg(long)]
    base: Option<BaseMount>,
    /// Physics engine: rapier (the reference), batch (SIMD, faster), or mujoco (in a Python process; see
    /// docs/physics.md). Default: batch.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Rate of the physics [Hz], a multiple of the actuator rate. Default: 200 with rapier, 1000 with batch and
    /// mujoco, rounded up to a multiple.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Solver iterations per physics step. Default: 2 with rapier, 4 with batch, at most 64 with mujoco.
    #[arg(long, value_name = "N")]
    solver_iterations: Option<u32>,
    /// Log to write: *.parquet, *.csv or *.csv.gz, or a folder, which gets data.parquet and meta.json.
    #[arg(long, value_name = "LOG")]
    out: PathBuf,
}

/// The log would overwrite the motion file.
#[derive(Debug, thiserror::Error)]
#[error("`--out` = {} is the motion file itself\n  name another file or folder", .0.display())]
struct SameFile(PathBuf);

/// Simulates the motion and writes the log.
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
    let config = args.config();
    let motion = Log::open_commands(&args.motion).map_err(input)?;
    let replayed = at_log_rate(&motion, &robot).map_err(input)?;
    config.check(replayed.control.actuator_hz).map_err(input)?;
    let at_rate = |learned: ActuatorNetworkRobot| learned.at_rate(replayed.control.actuator_hz);
    let learned = learned.map(at_rate).transpose().map_err(input)?;
    let actuators = || learned.as_ref().map(|learned| Box::new(learned.actuators(1, false)) as Box<dyn Actuator>);
    let signals = Signals::listen()?;
    let bar = ProgressBar::with_draw_target(Some(motion.rows() as u64), progress_lines::target());
    let result = play(&motion, &robot, &actuators, config, args.base, &mut |row| {
        bar.set_position(row as u64);
        !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    let log = result.map_err(|error| match error {
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

/// Simulates `robot` with the commands of `motion` and returns the log.
///
/// `base` replaces the mounting of all segments. `actuators` creates the actuators of one robot, or returns `None` for
/// the robot's own. `progress` receives the number of completed rows and returns false to interrupt the simulation.
pub fn play(
    motion: &Log,
    robot: &RobotModel,
    actuators: &dyn Fn() -> Option<Box<dyn Actuator>>,
    config: SimConfig,
    base: Option<BaseMount>,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Log, RecordError> {
    let based = |base| SimConfig { base, ..config };
    let source = source(&at_log_rate(motion, robot)?, config);
    let failed = |error: twinstep_sim::BackendBuildError| RecordError::Backend(Box::new(error));
    match config.engine {
        Engine::Rapier => record(
            motion,
            robot,
            base,
            |base, robot| {
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
            |base, robot| {
                let backend = BatchBackend::new(robot.clone(), based(base), 1).map_err(failed)?;
                Ok(if let Some(actuators) = actuators() { backend.with_actuator(actuators) } else { backend })
            },
            source,
            progress,
        ),
        Engine::Mujoco if actuators().is_none() && MujocoBackend::simulates(robot) => record(
            motion,
            robot,
            base,
            |base, robot| MujocoBackend::new(robot.clone(), based(base), 1).map_err(failed),
            source,
            progress,
        ),
        Engine::Mujoco => record(
            motion,
            robot,
            base,
            |base, robot| {
                let backend = MujocoPlant::new(robot.clone(), based(base), 1).map_err(failed)?;
                Ok(if let Some(actuators) = actuators() { backend.with_actuator(actuators) } else { backend })
            },
            source,
            progress,
        ),
    }
}

fn source(robot: &RobotModel, config: SimConfig) -> String {
    let config = config.at_actuator_rate(robot.control.actuator_hz);
    let (physics_hz, solver_iterations) = (config.physics_hz(), config.solver_iterations());
    let engine = match config.engine {
        Engine::Rapier => "rapier",
        Engine::Batch => "batch",
        Engine::Mujoco => "mujoco",
    };
    format!("twinstep play: `{}` simulated by {engine} at {physics_hz} Hz x {solver_iterations}", robot.name)
}
