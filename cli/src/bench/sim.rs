//! Physics on one core: what each setting costs, and what accuracy it buys against the finest one.

use twinstep_model::{Backend, Command, NUM_JOINTS, PerJoint, Placement, go2};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};

use super::Row;
use super::pace::{WINDOWS, measure as pace, median};
use crate::exit::{Failure, Outcome, Signals, other};
use crate::trot;

/// Engine, physics rate [Hz] and solver iterations.
type Setting = (Engine, u32, u32);

/// Wanted joint positions [rad] in a drive period of a motion.
type Target = fn(usize) -> PerJoint;

/// The shipped settings.
const SETTINGS: [Setting; 10] = [
    (Engine::Rapier, 200, 1),
    (Engine::Rapier, 200, 2),
    (Engine::Rapier, 200, 4),
    (Engine::Rapier, 400, 1),
    (Engine::Rapier, 1000, 1),
    (Engine::Rapier, 1000, 4),
    (Engine::Batch, 200, 4),
    (Engine::Batch, 400, 4),
    (Engine::Batch, 1000, 4),
    (Engine::Batch, 4000, 4),
];
/// What the others are compared with.
const FINEST: Setting = (Engine::Rapier, 4000, 4);
/// Robots in a measured batch.
const ROBOTS: usize = 64;
/// The height [m] from which the robots drop onto their feet, by millimetres.
const START_HEIGHT: f32 = 0.335;
/// Drive periods in the second that accuracy is measured over.
const SECOND: usize = 200;

/// Environment steps a second and joint error of every setting.
pub fn measure(window_s: f64, signals: &Signals) -> Result<Vec<Row>, Failure> {
    let motions: [(&str, Target); 2] = [("stance step", stance_step), ("trot", trot_target)];
    let finest = motions.iter().map(|(_, target)| joint_positions(FINEST, *target)).collect::<Result<Vec<_>, _>>()?;
    let finest_name = name(FINEST);
    let mut rows = Vec::new();
    for setting in SETTINGS {
        signals.check()?;
        let name = name(setting);
        rows.push(Row {
            case: format!("{name}, one core"),
            value: env_steps_per_second(setting, window_s)?,
            unit: "env-steps/s",
            reference: None,
            ratio: None,
        });
        for ((motion, target), finest) in motions.iter().zip(&finest) {
            let positions = joint_positions(setting, *target)?;
            rows.push(Row {
                case: format!("{name}, joint error, 1 s of {motion}"),
                value: rms_difference(&positions, finest),
                unit: "rad",
                reference: Some(finest_name.clone()),
                ratio: None,
            });
        }
    }
    Ok(rows)
}

fn name((engine, physics_hz, solver_iterations): Setting) -> String {
    let engine = match engine {
        Engine::Rapier => "rapier",
        Engine::Batch => "batch",
    };
    format!("{engine} {physics_hz} Hz x {solver_iterations}")
}

fn config((engine, physics_hz, solver_iterations): Setting) -> SimConfig {
    SimConfig { engine, physics_hz, solver_iterations, threads: 1, ..SimConfig::default() }
}

fn place(backend: &mut impl Backend) -> Outcome {
    let placement = Placement::at_rest(START_HEIGHT, go2().control.default_pose_f32());
    let placements: Vec<_> = (0..backend.num_robots()).map(|robot| (robot, placement)).collect();
    backend.reset(&placements).map_err(other)
}

fn command(target: PerJoint) -> Command {
    // kp 40, kd 1: stiff enough to stand on, in the range of policies for this robot.
    Command::hold(target, 40.0, 1.0)
}

fn env_steps_per_second(setting: Setting, window_s: f64) -> Result<f64, Failure> {
    match setting.0 {
        Engine::Rapier => pace_of(RapierBackend::new(go2(), config(setting), ROBOTS).map_err(other)?, window_s),
        Engine::Batch => pace_of(BatchBackend::new(go2(), config(setting), ROBOTS).map_err(other)?, window_s),
    }
}

fn pace_of(mut backend: impl Backend, window_s: f64) -> Result<f64, Failure> {
    place(&mut backend)?;
    let decimation = go2().control.decimation;
    let mut period = 0;
    let mut windows = Vec::new();
    for _ in 0..WINDOWS {
        windows.push(pace(window_s, || {
            period += decimation;
            let commands = vec![command(trot_target(period)); ROBOTS];
            backend.step(&commands, &[true; ROBOTS], decimation).map_err(other)
        })?);
    }
    Ok(median(&windows).per_second * ROBOTS as f64)
}

/// Joint positions after each drive period of one second, after half a second to settle.
fn joint_positions(setting: Setting, target: Target) -> Result<Vec<PerJoint>, Failure> {
    match setting.0 {
        Engine::Rapier => play(RapierBackend::new(go2(), config(setting), 1).map_err(other)?, target),
        Engine::Batch => play(BatchBackend::new(go2(), config(setting), 1).map_err(other)?, target),
    }
}

fn play(mut backend: impl Backend, target: Target) -> Result<Vec<PerJoint>, Failure> {
    place(&mut backend)?;
    let stand = command(go2().control.default_pose_f32());
    backend.step(&[stand], &[true], SECOND / 2).map_err(other)?;
    (0..SECOND)
        .map(|period| {
            backend.step(&[command(target(period))], &[true], 1).map_err(other)?;
            Ok(backend.states().q[0])
        })
        .collect()
}

/// Every joint is told to move by 0.2 rad at once.
fn stance_step(_: usize) -> PerJoint {
    let pose = go2().control.default_pose_f32();
    std::array::from_fn(|j| pose[j] + if j % 3 == 2 { -0.2 } else { 0.1 })
}

fn trot_target(period: usize) -> PerJoint {
    let control = go2().control;
    let (pose, action) = (control.default_pose_f32(), trot::action(period as f32 * control.drive_dt() as f32));
    std::array::from_fn(|j| pose[j] + control.action_scale as f32 * action[j])
}

fn rms_difference(one: &[PerJoint], other: &[PerJoint]) -> f64 {
    let squares: f64 =
        one.iter().flatten().zip(other.iter().flatten()).map(|(one, other)| f64::from(one - other).powi(2)).sum();
    (squares / (one.len() * NUM_JOINTS) as f64).sqrt()
}
