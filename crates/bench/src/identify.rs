//! Identification: closed-loop rollouts of the built-in recording's commands, and one whole identification.

use std::path::Path;
use std::time::Instant;

use rand::RngExt;
use twinstep_effects::ModelFile;
use twinstep_effects::{EffectEntry, apply_effects};
use twinstep_identify::{Experiment, IdentifyOptions, WindowConfig, identify};
use twinstep_logs::Log;
use twinstep_model::{BaseMount, JOINT_NAMES, MjcfActuator, MjcfOptions, Precision, RobotModel, go2, mjcf, stream};
use twinstep_sim::{BatchRollout, SimConfig};

use crate::Measurement;
use crate::baselines::{Baselines, Setup};
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, measure as pace, median_of};
use twinstep_identify::default_effects;
use twinstep_logs::recording;

/// Number of rollouts that are timed on all cores.
const ROLLOUTS: usize = 1000;
/// Length of each rollout [s].
const ROLLOUT_S: f64 = 10.0;
/// Candidates that are evaluated at a time: their trajectories fit into memory, and there is work for many cores.
const BATCH_SIZE: usize = 100;
/// Candidates that are evaluated at a time on one core: half a generation of the search, which fills SIMD registers.
const ON_ONE_CORE: usize = 16;
/// Number of robots in MuJoCo, which steps them one after the other.
const MUJOCO_ROBOTS: usize = 2;
/// Goal for the time of all rollouts on two cores [s].
const ROLLOUTS_GOAL_S: f64 = 10.0;
/// Goal for the time of one identification on two cores [s].
const IDENTIFICATION_GOAL_S: f64 = 20.0;

/// Measures rollouts [robot-s/s], the time of a thousand rollouts [s] and the time of one identification [s].
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let folder = std::env::temp_dir().join(format!("twinstep-bench-{}", std::process::id()));
    let log = recording::unpack(&folder);
    std::fs::remove_dir_all(&folder).map_err(failed)?;
    let log = log.map_err(failed)?;
    let first = log.t()[0];
    let experiment = Experiment::new(&log, &go2(), WindowConfig::IDENTIFICATION).map_err(failed)?;
    let rollouts = experiment.clone().filter_rows(|row| log.t()[row] - first <= ROLLOUT_S);
    let candidates = candidates()?;
    let mut baselines = Baselines::start(python, &setup(&log, window_s));
    let mut rows =
        on_one_core(&rollouts, &candidates[..ON_ONE_CORE], &mut baselines, window_s)?.into_iter().collect::<Vec<_>>();
    rows.extend(on_all_cores(&rollouts, &candidates, interrupted)?);
    rows.push(whole_identification(&experiment, interrupted)?);
    Ok(rows)
}

/// Returns robots with random values of the default effects of `twinstep identify`, within their prior ranges.
fn candidates() -> Result<Vec<RobotModel>, BenchError> {
    let mut random = stream(1, "bench identify", 0);
    let mut candidate = || {
        let entries = default_effects().into_iter().map(|(effect, scope)| {
            let values = effect.parameters.iter().map(|parameter| {
                let [low, high] = parameter.prior_range;
                random.random_range(low..high)
            });
            EffectEntry::new(effect, scope, values.collect()).map_err(failed)
        });
        apply_effects(&go2(), &entries.collect::<Result<Vec<_>, _>>()?).map_err(failed)
    };
    (0..ROLLOUTS).map(|_| candidate()).collect()
}

fn simulator(threads: usize) -> Result<BatchRollout, BenchError> {
    BatchRollout::new(&go2(), &SimConfig { threads, ..SimConfig::default() }).map_err(failed)
}

/// Measures windows of single precision, double precision and MuJoCo alternately.
fn on_one_core(
    rollouts: &Experiment,
    candidates: &[RobotModel],
    baselines: &mut Baselines,
    window_s: f64,
) -> Result<[Measurement; 2], BenchError> {
    let hz = SimConfig::default().physics_hz();
    let (mut simulator, baseline) = (simulator(1)?, format!("mujoco {hz}"));
    let (mut single, mut double, mut theirs) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        for (precision, paces) in [(Precision::Single, &mut single), (Precision::Double, &mut double)] {
            let rate = pace(window_s, || {
                rollouts.residuals(&mut simulator, candidates, precision);
                Ok(())
            })?;
            paces.push(rate.per_second * candidates.len() as f64 * ROLLOUT_S);
        }
        if baselines.has(&baseline) {
            // Its steps are actuator periods.
            theirs.push(baselines.window(&baseline)? * go2().control.actuator_dt());
        }
    }
    let (single, double) = (median_of(single), median_of(double));
    let theirs = (!theirs.is_empty()).then(|| median_of(theirs));
    let row = |numbers: &str, value: f64, reference: Option<(String, f64)>| Measurement {
        case: format!("closed-loop rollouts, batch {numbers} {hz} Hz, one core"),
        value,
        unit: "robot-s/s",
        ratio: reference.as_ref().map(|(_, reference)| value / reference),
        reference: reference.map(|(reference, pace)| format!("{reference}, {pace:.0} robot-s/s")),
    };
    Ok([
        row("f32", single, theirs.map(|theirs| (format!("MuJoCo C {hz} Hz, one thread"), theirs))),
        row("f64", double, Some(("f32".to_owned(), single))),
    ])
}

fn on_all_cores(
    rollouts: &Experiment,
    candidates: &[RobotModel],
    interrupted: Interrupted,
) -> Result<[Measurement; 2], BenchError> {
    let mut simulator = simulator(0)?;
    let since = Instant::now();
    for candidates in candidates.chunks(BATCH_SIZE) {
        check(interrupted)?;
        rollouts.residuals(&mut simulator, candidates, Precision::Single);
    }
    let seconds = since.elapsed().as_secs_f64();
    let row = |case: &str, value: f64, unit: &'static str| Measurement {
        case: format!("{ROLLOUTS} closed-loop rollouts of {ROLLOUT_S} s, {case}"),
        value,
        unit,
        reference: Some(format!("goal of {ROLLOUTS_GOAL_S} s for all")),
        ratio: Some(ROLLOUTS_GOAL_S / seconds),
    };
    Ok([row("all cores", ROLLOUTS as f64 * ROLLOUT_S / seconds, "robot-s/s"), row("time", seconds, "s")])
}

fn whole_identification(experiment: &Experiment, interrupted: Interrupted) -> Result<Measurement, BenchError> {
    let (model, effects, mut simulator) = (ModelFile::default(), default_effects(), simulator(0)?);
    let since = Instant::now();
    let found = identify(
        &model,
        &effects,
        std::slice::from_ref(experiment),
        &mut simulator,
        &IdentifyOptions::default(),
        &mut |_, _, _| !interrupted(),
    );
    let seconds = since.elapsed().as_secs_f64();
    if found.map_err(failed)?.checkpoint.is_some() {
        return Err(BenchError::Interrupted);
    }
    Ok(Measurement {
        case: format!("identify {} parameters from 16 s of twelve joints", effects.len()),
        value: seconds,
        unit: "s",
        reference: Some(format!("goal of {IDENTIFICATION_GOAL_S} s")),
        ratio: Some(IDENTIFICATION_GOAL_S / seconds),
    })
}

/// Returns the setup with which MuJoCo follows the same commands, with position actuators in the model.
fn setup(log: &Log, window_s: f64) -> Setup {
    let (control, hz) = (go2().control, SimConfig::default().physics_hz());
    let actuator = MjcfActuator::Position {
        kp: log.kp(JOINT_NAMES[0], 0).unwrap_or(control.kp[0]),
        kd: log.kd(JOINT_NAMES[0], 0).unwrap_or(control.kd[0]),
    };
    let model = mjcf(
        &go2(),
        &MjcfOptions { base: BaseMount::Fixed, timestep: 1.0 / f64::from(hz), actuator, ..MjcfOptions::default() },
    );
    let periods = (ROLLOUT_S / control.actuator_dt()).round() as usize;
    let target = |row: usize| {
        let command = |(name, pose): (&&str, f64)| log.q_cmd(name).map_or(pose, |cells| cells[row]) as f32;
        JOINT_NAMES.iter().zip(control.default_pose).map(command).collect()
    };
    Setup {
        models: [(format!("mujoco {hz}"), model)].into(),
        threads: Vec::new(),
        targets: (0..periods).map(target).collect(),
        actions: Vec::new(),
        policy_dt: control.actuator_dt(),
        restarts: false,
        num_envs: MUJOCO_ROBOTS,
        window_s,
    }
}
