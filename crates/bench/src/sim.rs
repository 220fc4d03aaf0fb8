//! Physics on one core: speed of each setting compared with other simulators, and accuracy compared with the finest
//! one.

use std::collections::BTreeMap;
use std::path::Path;

use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_model::{
    AutoresetMode, Backend, Command, InitialState, MjcfActuator, MjcfOptions, NUM_JOINTS, PerJoint, ResetRequest, go2,
    mjcf,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig, SimdPrecision};
use twinstep_simd::InstructionSet;

use crate::Measurement;
use crate::baselines::{Baselines, Setup};
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, measure as pace, median_of};
use twinstep_envs::trot;

/// Simulator with its settings.
#[derive(Clone, Copy)]
struct Setting {
    simulator: Simulator,
    physics_hz: u32,
    solver_iterations: u32,
}

#[derive(Clone, Copy)]
enum Simulator {
    Rapier,
    Batch(SimdPrecision),
}

/// Function that returns the joint position targets [rad] of an actuator period of a motion.
type Target = fn(usize) -> PerJoint;

const fn rapier(physics_hz: u32, solver_iterations: u32) -> Setting {
    Setting { simulator: Simulator::Rapier, physics_hz, solver_iterations }
}

fn batch(lanes: SimdPrecision, physics_hz: u32) -> Setting {
    Setting { simulator: Simulator::Batch(lanes), physics_hz, solver_iterations: 4 }
}

fn fastest(physics_hz: u32) -> Setting {
    batch(SimdPrecision::Single(InstructionSet::best()), physics_hz)
}

/// Returns all measured settings: rapier, and the batch engine with each instruction set of this processor.
fn settings() -> Vec<Setting> {
    let mut settings =
        vec![rapier(200, 1), rapier(200, 2), rapier(200, 4), rapier(400, 1), rapier(1000, 1), rapier(1000, 4)];
    for instructions in InstructionSet::available() {
        settings.extend([200, 400, 1000].map(|physics_hz| batch(SimdPrecision::Single(instructions), physics_hz)));
    }
    settings.extend([fastest(4000), batch(SimdPrecision::Double, 1000)]);
    settings
}

/// Reference for the accuracy of the other settings.
const FINEST: Setting = rapier(4000, 4);
/// Physics rates at which MuJoCo is measured [Hz].
const MUJOCO_HZ: [u32; 3] = [200, 400, 1000];
/// Numbers of threads at which EnvPool is measured.
const ENVPOOL_THREADS: [usize; 2] = [1, 2];
/// Physics rate of the environments [Hz]: the default. EnvPool has 250.
const ENVS_HZ: u32 = 1000;
/// Number of robots in the comparison of one and two cores.
const MANY: usize = 1024;
/// Number of robots in the other speed measurements.
pub(crate) const ROBOTS: usize = 64;
/// Initial height of the base [m], from which the robots drop by some millimetres onto their feet.
const START_HEIGHT: f32 = 0.335;
/// Number of actuator periods of the second over which accuracy is measured.
const SECOND: usize = 200;
/// Policy periods of the baselines' motion: one cycle of the trot.
const CYCLE: usize = 25;
/// Position gain [N·m/rad]: high enough to stand, in the range of policies for this robot.
const KP: f32 = 40.0;
/// Velocity gain [N·m·s/rad].
const KD: f32 = 1.0;

/// Measures env-steps/s and joint error of every setting, and the simulators of the interpreter `python`.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let motions: [(&str, Target); 2] = [("stance step", stance_step), ("trot", trot_target)];
    let finest = motions.iter().map(|(_, target)| joint_positions(FINEST, *target)).collect::<Result<Vec<_>, _>>()?;
    let finest_name = name(FINEST);
    let mut baselines = Baselines::start(python, &setup(window_s));
    let (mut rows, mut mujoco) = (Vec::new(), BTreeMap::<u32, Vec<f64>>::new());
    for setting in settings() {
        check(interrupted)?;
        let name = name(setting);
        let case = format!("{name}, one core");
        let (ours, theirs) = compare_with_mujoco(setting, &mut baselines, window_s)?;
        let reference = mujoco_name(setting.physics_hz);
        rows.extend(speed_rows(&case, setting.physics_hz, ours, theirs.map(|rate| (&*reference, rate))));
        mujoco.entry(setting.physics_hz).or_default().extend(theirs);
        for ((motion, target), finest) in motions.iter().zip(&finest) {
            let positions = joint_positions(setting, *target)?;
            rows.push(Measurement {
                case: format!("{name}, joint error, 1 s of {motion}"),
                value: rms_difference(&positions, finest),
                unit: "rad",
                reference: Some(finest_name.clone()),
                ratio: None,
            });
        }
    }
    for (physics_hz, rates) in mujoco.into_iter().filter(|(_, rates)| !rates.is_empty()) {
        rows.extend(speed_rows(&mujoco_name(physics_hz), physics_hz, median_of(rates), None));
    }
    for threads in ENVPOOL_THREADS {
        check(interrupted)?;
        rows.extend(compare_with_envpool(threads, &mut baselines, window_s)?);
    }
    rows.extend(task_and_engine(window_s)?);
    Ok(rows)
}

/// Returns env-steps/s and the time per physics step of one robot [µs], compared with a reference.
fn speed_rows(case: &str, physics_hz: u32, rate: f64, reference: Option<(&str, f64)>) -> [Measurement; 2] {
    let steps = go2().control.policy_dt() * f64::from(physics_hz);
    let row = |case: String, value: f64, unit: &'static str| Measurement {
        case,
        value,
        unit,
        reference: reference.map(|(name, _)| name.to_owned()),
        // Both rows compare the same speeds.
        ratio: reference.map(|(_, theirs)| rate / theirs),
    };
    [
        row(case.to_owned(), rate, "env-steps/s"),
        row(format!("{case}, one physics step of one robot"), 1e6 / (rate * steps), "us"),
    ]
}

/// Measures env-steps/s of a setting and, if installed, of MuJoCo at the same physics rate, alternately.
fn compare_with_mujoco(
    setting: Setting,
    baselines: &mut Baselines,
    window_s: f64,
) -> Result<(f64, Option<f64>), BenchError> {
    let baseline = format!("mujoco {}", setting.physics_hz);
    match setting.simulator {
        Simulator::Rapier => {
            let backend = RapierBackend::new(go2(), config(setting), ROBOTS).map_err(failed)?;
            compare_with_baseline(trotting(backend)?, baselines, &baseline, window_s)
        }
        Simulator::Batch(lanes) => {
            let backend = BatchBackend::with_precision(go2(), config(setting), ROBOTS, lanes).map_err(failed)?;
            compare_with_baseline(trotting(backend)?, baselines, &baseline, window_s)
        }
    }
}

/// Measures our environments and EnvPool's, both with observations, rewards and resets.
fn compare_with_envpool(
    threads: usize,
    baselines: &mut Baselines,
    window_s: f64,
) -> Result<Vec<Measurement>, BenchError> {
    let baseline = format!("EnvPool Go1 (flat), {ROBOTS} envs, {threads} thread(s)");
    let name_in_child = format!("envpool {threads}");
    let (ours, theirs) = compare_with_baseline(walking(ROBOTS, threads)?, baselines, &name_in_child, window_s)?;
    let case = format!("walk, {}, {ROBOTS} envs, {threads} thread(s)", name(fastest(ENVS_HZ)));
    let mut rows = vec![row(case, ours, theirs.map(|theirs| (&*baseline, theirs)))];
    rows.extend(theirs.map(|theirs| row(baseline.clone(), theirs, None)));
    Ok(rows)
}

/// Measures the cost of the task compared with the bare engine, and the speed-up by the second core.
fn task_and_engine(window_s: f64) -> Result<[Measurement; 3], BenchError> {
    let bare = |threads| {
        let config = SimConfig { threads, ..config(fastest(ENVS_HZ)) };
        trotting(BatchBackend::new(go2(), config, MANY).map_err(failed)?)
    };
    let (walk, engine) = alternately(walking(MANY, 1)?, bare(1)?, window_s)?;
    let (both, one) = alternately(bare(2)?, bare(1)?, window_s)?;
    let (walk_both, engine_both) = alternately(walking(MANY, 2)?, bare(2)?, window_s)?;
    let name = name(fastest(ENVS_HZ));
    let reference = format!("bare {name}, {MANY} robots, one core");
    let reference_both = format!("bare {name}, {MANY} robots, two threads");
    Ok([
        row(format!("walk, {name}, {MANY} envs, one core"), walk, Some((&reference, engine))),
        row(reference_both.clone(), both, Some((&reference, one))),
        row(format!("walk, {name}, {MANY} envs, two threads"), walk_both, Some((&reference_both, engine_both))),
    ])
}

/// Returns a function that steps `num_envs` environments of the task `walk` by one policy period.
fn walking(num_envs: usize, threads: usize) -> Result<impl FnMut() -> Result<(), BenchError>, BenchError> {
    let config = Config { sim: SimConfig { threads, ..config(fastest(ENVS_HZ)) }, ..Config::default() };
    let mut envs = SimEnvFactory::new(config)
        .and_then(|host| host.build(num_envs, AutoresetMode::NextStep, None))
        .map_err(failed)?;
    envs.reset(&ResetRequest::seeded(1, num_envs)).map_err(failed)?;
    let mut step = 0;
    Ok(move || {
        let action = trot::action(step as f32 * envs.spec().policy_dt as f32);
        step += 1;
        envs.step(&action.repeat(num_envs)).map(drop).map_err(failed)
    })
}

fn row(case: String, value: f64, reference: Option<(&str, f64)>) -> Measurement {
    Measurement {
        case,
        value,
        unit: "env-steps/s",
        reference: reference.map(|(name, _)| name.to_owned()),
        ratio: reference.map(|(_, theirs)| value / theirs),
    }
}

/// Measures env-steps/s of two functions that step [`MANY`] robots, in alternate windows.
fn alternately(
    mut one: impl FnMut() -> Result<(), BenchError>,
    mut other: impl FnMut() -> Result<(), BenchError>,
    window_s: f64,
) -> Result<(f64, f64), BenchError> {
    let (mut first, mut second) = (Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        first.push(pace(window_s, &mut one)?.per_second * MANY as f64);
        second.push(pace(window_s, &mut other)?.per_second * MANY as f64);
    }
    Ok((median_of(first), median_of(second)))
}

/// Measures env-steps/s of `once`, which steps [`ROBOTS`] robots, and of a baseline, in alternate windows.
pub(crate) fn compare_with_baseline(
    mut once: impl FnMut() -> Result<(), BenchError>,
    baselines: &mut Baselines,
    baseline: &str,
    window_s: f64,
) -> Result<(f64, Option<f64>), BenchError> {
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        ours.push(pace(window_s, &mut once)?.per_second * ROBOTS as f64);
        if baselines.has(baseline) {
            theirs.push(baselines.window(baseline)?);
        }
    }
    Ok((median_of(ours), (!theirs.is_empty()).then(|| median_of(theirs))))
}

/// Returns the setup with which the baselines execute the same trot.
fn setup(window_s: f64) -> Setup {
    let control = go2().control;
    let model = |physics_hz: u32| {
        let actuator = MjcfActuator::Position { kp: f64::from(KP), kd: f64::from(KD) };
        let timestep = 1.0 / f64::from(physics_hz);
        (format!("mujoco {physics_hz}"), mjcf(&go2(), &MjcfOptions { timestep, actuator, ..MjcfOptions::default() }))
    };
    Setup {
        models: MUJOCO_HZ.into_iter().map(model).collect(),
        threads: ENVPOOL_THREADS.to_vec(),
        targets: (0..CYCLE).map(|period| trot_target(period * control.decimation).to_vec()).collect(),
        actions: (0..CYCLE).map(|period| trot::action(period as f32 * control.policy_dt() as f32).to_vec()).collect(),
        policy_dt: control.policy_dt(),
        restarts: false,
        num_envs: ROBOTS,
        window_s,
    }
}

fn name(Setting { simulator, physics_hz, solver_iterations }: Setting) -> String {
    let simulator = match simulator {
        Simulator::Rapier => "rapier".to_owned(),
        Simulator::Batch(SimdPrecision::Single(instructions)) => format!("batch {instructions}"),
        Simulator::Batch(SimdPrecision::Double) => "batch f64".to_owned(),
    };
    format!("{simulator} {physics_hz} Hz x {solver_iterations}")
}

fn mujoco_name(physics_hz: u32) -> String {
    format!("MuJoCo C {physics_hz} Hz, one thread")
}

fn config(Setting { simulator, physics_hz, solver_iterations }: Setting) -> SimConfig {
    let engine = match simulator {
        Simulator::Rapier => Engine::Rapier,
        Simulator::Batch(_) => Engine::Batch,
    };
    let (physics_hz, solver_iterations) = (Some(physics_hz), Some(solver_iterations));
    SimConfig { engine, physics_hz, solver_iterations, threads: 1, ..SimConfig::default() }
}

fn reset_all(backend: &mut impl Backend) -> Result<(), BenchError> {
    let start = InitialState::at_rest(START_HEIGHT, go2().control.default_pose_f32());
    let starts: Vec<_> = (0..backend.num_robots()).map(|robot| (robot, start)).collect();
    backend.reset(&starts).map_err(failed)
}

fn command(target: PerJoint) -> Command {
    Command::hold(target, KP, KD)
}

/// Returns a function that steps all robots of `backend` by one policy period.
fn trotting(mut backend: impl Backend) -> Result<impl FnMut() -> Result<(), BenchError>, BenchError> {
    reset_all(&mut backend)?;
    let (decimation, active) = (go2().control.decimation, vec![true; backend.num_robots()]);
    let mut period = 0;
    Ok(move || {
        period += decimation;
        let commands = vec![command(trot_target(period)); active.len()];
        backend.step(&commands, &active, decimation).map_err(failed)
    })
}

/// Returns the joint positions after each actuator period of one second, after half a second of settling.
fn joint_positions(setting: Setting, target: Target) -> Result<Vec<PerJoint>, BenchError> {
    match setting.simulator {
        Simulator::Rapier => record(RapierBackend::new(go2(), config(setting), 1).map_err(failed)?, target),
        Simulator::Batch(lanes) => {
            record(BatchBackend::with_precision(go2(), config(setting), 1, lanes).map_err(failed)?, target)
        }
    }
}

fn record(mut backend: impl Backend, target: Target) -> Result<Vec<PerJoint>, BenchError> {
    reset_all(&mut backend)?;
    let stand = command(go2().control.default_pose_f32());
    backend.step(&[stand], &[true], SECOND / 2).map_err(failed)?;
    (0..SECOND)
        .map(|period| {
            backend.step(&[command(target(period))], &[true], 1).map_err(failed)?;
            Ok(backend.measured().q[0])
        })
        .collect()
}

/// Returns the targets of a step: thighs and hips by 0.1 rad, calves by −0.2 rad.
fn stance_step(_: usize) -> PerJoint {
    let pose = go2().control.default_pose_f32();
    std::array::from_fn(|j| pose[j] + if j % 3 == 2 { -0.2 } else { 0.1 })
}

fn trot_target(period: usize) -> PerJoint {
    let control = go2().control;
    let (pose, action) = (control.default_pose_f32(), trot::action(period as f32 * control.actuator_dt() as f32));
    std::array::from_fn(|j| pose[j] + control.action_scale as f32 * action[j])
}

fn rms_difference(one: &[PerJoint], other: &[PerJoint]) -> f64 {
    let squares: f64 =
        one.iter().flatten().zip(other.iter().flatten()).map(|(one, failed)| f64::from(one - failed).powi(2)).sum();
    (squares / (one.len() * NUM_JOINTS) as f64).sqrt()
}
