//! Evaluation of a policy at the end of its training.

use twinstep_envs::{JumpConfig, TaskConfig};
use twinstep_learning::{Evaluation, EvaluationError, EvaluationPlan, evaluate};
use twinstep_policy::Policy;
use twinstep_sim::{Engine, SimConfig};

use crate::evaluate_attitude::{self, AttitudeErrors, AttitudeRow};
use crate::evaluate_jump::{self, JumpRow};
use crate::evaluate_policy::check_spec;
use crate::evaluate_pose::{self, PoseErrors};
use crate::exit::{Failure, Signals, other};
use crate::train_config::TrainConfig;
use crate::train_endpoints::remote_env;

/// Robots, simulated time [s] and seed of the evaluation.
const ROBOTS: usize = 256;
const SECONDS: f64 = 20.0;
const SEED: u64 = 1_000_000;

/// Evaluates `policy`, which was trained with `config` on the robots of these servers, or in this process if there are
/// none. Returns the evaluation as JSON and as a table.
///
/// The robots are fresh ones of the server, or of the training's model with default commands and physics. Jumps and the
/// attitude are evaluated in this process only.
pub fn evaluate_policy(
    policy: &Policy,
    config: &TrainConfig,
    endpoints: &[String],
    signals: &Signals,
) -> Result<(String, String), Failure> {
    let json = |evaluation: serde_json::Result<String>| evaluation.expect("an evaluation is plain data");
    let text = |table: String| {
        let of = "Simulated here, with the model and the targets of this command; those of the servers may differ.\n";
        if endpoints.is_empty() { table } else { of.to_owned() + &table }
    };
    if let TaskConfig::Jump(task) = &config.task {
        let targets = jumps(policy, config, task, signals)?;
        let rows = [JumpRow { condition: "nominal", engine: Engine::Batch, targets }];
        let table = evaluate_jump::table(ROBOTS as u32, &rows);
        return Ok((json(serde_json::to_string_pretty(&rows[0].targets)), text(table)));
    }
    if let TaskConfig::Attitude(_) = &config.task {
        let errors = attitude(policy, config, signals)?;
        let rows = [AttitudeRow { condition: "nominal", engine: Engine::Batch, errors }];
        let table = evaluate_attitude::table(ROBOTS as u32, SECONDS, &rows);
        return Ok((json(serde_json::to_string_pretty(&rows[0].errors)), text(table)));
    }
    if let TaskConfig::Pose(_) = &config.task {
        let errors = pose(policy, config, signals)?;
        let table = evaluate_pose::table(ROBOTS, SECONDS, &errors);
        return Ok((json(serde_json::to_string_pretty(&errors)), text(table)));
    }
    let evaluation = walking(policy, config, endpoints, signals)?;
    Ok((json(serde_json::to_string_pretty(&evaluation)), evaluation_text(&evaluation)))
}

fn walking(
    policy: &Policy,
    config: &TrainConfig,
    endpoints: &[String],
    signals: &Signals,
) -> Result<Evaluation, Failure> {
    let fresh = fresh(config, config.task.with_default_settings());
    let robot = fresh.robots(1)?.control();
    let plan = EvaluationPlan { feet: &robot.feet, torque_limits: &robot.torque_limits, seconds: SECONDS, seed: SEED };
    let proceed = |_: f64| signals.check().is_ok();
    let failure = |error| match error {
        EvaluationError::Stopped => Failure::Interrupted,
        _ => other(error),
    };
    if endpoints.is_empty() {
        let mut env = fresh.envs(ROBOTS, 1, 0)?.remove(0);
        return evaluate(policy, env.as_mut(), plan, proceed).map_err(failure);
    }
    let mut env = remote_env(endpoints, ROBOTS)?;
    let evaluation = evaluate(policy, &mut env, plan, proceed).map_err(failure)?;
    env.close().map_err(other)?;
    Ok(evaluation)
}

fn jumps(
    policy: &Policy,
    config: &TrainConfig,
    trained: &JumpConfig,
    signals: &Signals,
) -> Result<Vec<evaluate_jump::Landings>, Failure> {
    let mut targets = Vec::new();
    for task in evaluate_jump::tasks(trained) {
        let fresh = fresh(config, TaskConfig::Jump(task.clone()));
        let mut env = fresh.envs(ROBOTS, 1, 0)?.remove(0);
        let proceed = |_: f64| signals.check().is_ok();
        check_spec(policy, env.spec())?;
        let landings = evaluate_jump::evaluate(policy, env.as_mut(), &fresh.quadruped()?, &task, SEED, proceed);
        targets.push(landings.map_err(other)?.ok_or(Failure::Interrupted)?);
    }
    Ok(targets)
}

fn attitude(policy: &Policy, config: &TrainConfig, signals: &Signals) -> Result<AttitudeErrors, Failure> {
    let mut env = fresh(config, TaskConfig::Attitude(evaluate_attitude::task())).envs(ROBOTS, 1, 0)?.remove(0);
    check_spec(policy, env.spec())?;
    let proceed = |_: f64| signals.check().is_ok();
    let errors = evaluate_attitude::evaluate(policy, env.as_mut(), (SECONDS, SEED), proceed);
    errors.map_err(other)?.ok_or(Failure::Interrupted)
}

fn pose(policy: &Policy, config: &TrainConfig, signals: &Signals) -> Result<PoseErrors, Failure> {
    let mut env = fresh(config, config.task.with_default_settings()).envs(ROBOTS, 1, 0)?.remove(0);
    check_spec(policy, env.spec())?;
    let proceed = |_: f64| signals.check().is_ok();
    evaluate_pose::evaluate(policy, env.as_mut(), (SECONDS, SEED), proceed).map_err(other)?.ok_or(Failure::Interrupted)
}

/// Returns the training's robot with default physics.
fn fresh(config: &TrainConfig, task: TaskConfig) -> TrainConfig {
    TrainConfig { model: config.model.clone(), task, sim: SimConfig::default(), ..TrainConfig::default() }
}

/// Returns the table of an evaluation.
fn evaluation_text(evaluation: &Evaluation) -> String {
    let Evaluation { robots, seconds, up, velocity_rms, settled_velocity_rms, .. } = evaluation;
    let Evaluation { yaw_rate_rms, settled_yaw_rate_rms, swing_height, duty_factor, .. } = evaluation;
    format!(
        "{robots} fresh robots, {seconds:.0} s, mean action:\n\
         \x20 still up                 {:.1} %\n\
         \x20 velocity error, RMS      {velocity_rms:.3} m/s   ({settled_velocity_rms:.3} from 1 s after each new command)\n\
         \x20 yaw rate error, RMS      {yaw_rate_rms:.3} rad/s ({settled_yaw_rate_rms:.3})\n\
         \x20 swing height of the sole {:.1} cm, duty factor {duty_factor:.2}, {:.1} swings/s per foot\n\
         \x20 speed of feet on ground  {:.3} m/s\n",
        100.0 * up,
        100.0 * swing_height,
        evaluation.swings_per_second,
        evaluation.slip_speed,
    )
}
