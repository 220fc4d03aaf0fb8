//! Robots that walk on the batch engine, driven by an ensemble, on one core.

use twinstep_effects::{ActuatorNetworkConfig, MemberSampling, ModelFile};
use twinstep_ensemble::ActuatorNetworkRobot;
use twinstep_envs::{Randomisation, TaskConfig, TaskEnv, TaskEnvConfig};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv, go2};
use twinstep_sim::{BatchBackend, SimConfig};

use super::{MEMBERS, ensemble};
use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, measure as pace, median_of};
use twinstep_envs::trot;

/// Robots that are stepped together: what six networks remember of 64 fits into a core's own cache.
const ROBOTS: [usize; 2] = [64, 1024];

/// Who actuators the robots.
#[derive(Clone, Copy)]
enum ActuatorKind {
    /// Their own.
    Analytic,
    /// One member a robot, drawn when it is placed.
    NetworkPerEpisode,
    /// One member a robot and actuator period: all hear of every robot, and their disagreement is evaluated once a step.
    NetworkPerStep,
}

/// Env-steps a second of each kind of actuator.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let rows: Result<Vec<_>, _> =
        ROBOTS.into_iter().map(|robots| side_by_side(robots, window_s, interrupted)).collect();
    Ok(rows?.concat())
}

/// Windows of all actuators in turn.
fn side_by_side(robots: usize, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let cases = [
        (ActuatorKind::Analytic, "own actuators"),
        (ActuatorKind::NetworkPerEpisode, "one member an episode"),
        (ActuatorKind::NetworkPerStep, "six members and EUF"),
    ];
    let mut walks = cases.iter().map(|(actuators, _)| walking(*actuators, robots)).collect::<Result<Vec<_>, _>>()?;
    let mut rates = vec![Vec::new(); cases.len()];
    for _ in 0..WINDOWS {
        for (walk, rates) in walks.iter_mut().zip(&mut rates) {
            check(interrupted)?;
            rates.push(pace(window_s, walk)?.per_second * robots as f64);
        }
    }
    let rates: Vec<f64> = rates.into_iter().map(median_of).collect();
    let row = |((_, name), rate): (&(ActuatorKind, &str), &f64)| Measurement {
        case: format!("walk, {robots} robots, one core, {name}"),
        value: *rate,
        unit: "env-steps/s",
        reference: Some("own actuators".to_owned()),
        ratio: Some(rate / rates[0]),
    };
    Ok(cases.iter().zip(&rates).map(row).collect())
}

/// A policy period of robots that are told to trot, again and again.
fn walking(actuators: ActuatorKind, robots: usize) -> Result<impl FnMut() -> Result<(), BenchError>, BenchError> {
    let sim = SimConfig { threads: 1, physics_hz: Some(1000), ..SimConfig::default() };
    let backend = BatchBackend::new(go2(), sim, robots).map_err(failed)?;
    let draw = match actuators {
        ActuatorKind::Analytic | ActuatorKind::NetworkPerEpisode => MemberSampling::PerEpisode,
        ActuatorKind::NetworkPerStep => MemberSampling::PerStep,
    };
    let settings = ActuatorNetworkConfig { ensemble: "measured".into(), draw, sample: false };
    let learned = ActuatorNetworkRobot::new(&ModelFile::default(), ensemble(MEMBERS), settings).map_err(failed)?;
    let backend = match actuators {
        ActuatorKind::Analytic => backend,
        ActuatorKind::NetworkPerEpisode => backend.with_actuator(Box::new(learned.actuators(robots, false))),
        ActuatorKind::NetworkPerStep => backend.with_actuator(Box::new(learned.actuators(robots, true))),
    };
    let settings = TaskEnvConfig {
        task: TaskConfig::default(),
        randomise: Randomisation::default(),
        robot_sampler: None,
        autoreset: AutoresetMode::NextStep,
        max_episode_steps: None,
        seed: 1,
    };
    let mut envs = TaskEnv::new(backend, settings).map_err(failed)?;
    envs.reset(&ResetRequest::seeded(1, robots)).map_err(failed)?;
    let mut step = 0;
    Ok(move || {
        let action = trot::action(step as f32 * envs.spec().policy_dt as f32);
        step += 1;
        envs.step(&action.repeat(robots)).map(drop).map_err(failed)
    })
}
