//! Walking robots in the batch engine with an ensemble as actuators, on one core.

use twinstep_effects::{ActuatorNetworkConfig, MemberSampling, ModelFile};
use twinstep_ensemble::ActuatorNetworkRobot;
use twinstep_envs::{TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv, go2};
use twinstep_sim::{BatchBackend, SimConfig};

use super::{MEMBERS, ensemble};
use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, measure as pace, median_of};
use twinstep_envs::trot;

/// Numbers of robots. The states of six networks for 64 robots fit into the cache of a core.
const ROBOTS: [usize; 2] = [64, 1024];

/// Actuators of the robots.
#[derive(Clone, Copy)]
enum ActuatorKind {
    /// Analytic actuators of the robot model.
    Analytic,
    /// One member per robot, sampled at each reset.
    NetworkPerEpisode,
    /// One member per robot and actuator period. All members receive the inputs of every robot, and the epistemic
    /// uncertainty is evaluated once per step.
    NetworkPerStep,
}

/// Measures env-steps/s with each kind of actuators.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let rows: Result<Vec<_>, _> = ROBOTS.into_iter().map(|robots| compare(robots, window_s, interrupted)).collect();
    Ok(rows?.concat())
}

/// Measures windows of all kinds of actuators alternately.
fn compare(robots: usize, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let cases = [
        (ActuatorKind::Analytic, "analytic actuators"),
        (ActuatorKind::NetworkPerEpisode, "one member per episode"),
        (ActuatorKind::NetworkPerStep, "six members with uncertainty"),
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
        reference: Some("analytic actuators".to_owned()),
        ratio: Some(rate / rates[0]),
    };
    Ok(cases.iter().zip(&rates).map(row).collect())
}

/// Returns a function that steps trotting robots by one policy period.
fn walking(actuators: ActuatorKind, robots: usize) -> Result<impl FnMut() -> Result<(), BenchError>, BenchError> {
    let sim = SimConfig { threads: 1, physics_hz: Some(1000), ..SimConfig::default() };
    let backend = BatchBackend::new(go2(), sim, robots).map_err(failed)?;
    let draw = match actuators {
        ActuatorKind::Analytic | ActuatorKind::NetworkPerEpisode => MemberSampling::PerEpisode,
        ActuatorKind::NetworkPerStep => MemberSampling::PerStep,
    };
    let settings = ActuatorNetworkConfig { ensemble: "measured".into(), draw, ..ActuatorNetworkConfig::default() };
    let learned = ActuatorNetworkRobot::new(&ModelFile::default(), ensemble(MEMBERS), settings).map_err(failed)?;
    let backend = match actuators {
        ActuatorKind::Analytic => backend,
        ActuatorKind::NetworkPerEpisode => backend.with_actuator(Box::new(learned.actuators(robots, false))),
        ActuatorKind::NetworkPerStep => backend.with_actuator(Box::new(learned.actuators(robots, true))),
    };
    let settings = TaskEnvConfig::new(AutoresetMode::NextStep, 1);
    let walk = Walk::new(WalkConfig::default(), &go2(), true).map_err(failed)?;
    let mut envs = TaskEnv::new(backend, walk, settings).map_err(failed)?;
    envs.reset(&ResetRequest::seeded(1, robots)).map_err(failed)?;
    let mut step = 0;
    Ok(move || {
        let action = trot::action(step as f32 * envs.spec().policy_dt as f32);
        step += 1;
        envs.step(&action.repeat(robots)).map(drop).map_err(failed)
    })
}
