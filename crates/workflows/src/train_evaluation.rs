//! Evaluation of a policy at the end of its training.

use twinstep_envs::{JumpConfig, TaskConfig, WalkConfig};
use twinstep_measures::{
    AttitudeErrors, AttitudeFollowing, Evaluation, GETUP_S, GettingUp, GettingUpTimes, JUMP_S, Jumping, Landings,
    Measure, MeasureError, PoseErrors, PoseFollowing, Run, Walking, measure,
};
use twinstep_model::{EnvSpec, VecEnv};
use twinstep_policy::Policy;
use twinstep_sim::{Engine, SimConfig};

use crate::failure::{Failure, other};
use crate::measure_tables::{self, ByTarget, Row};
use crate::observer::Observer;
use crate::train_config::TrainConfig;
use crate::train_endpoints::remote_env;

/// Robots, simulated time [s] and seed of the evaluation.
const ROBOTS: usize = 256;
const RUN: Run = Run { seconds: 20.0, seed: 1_000_000 };

/// Evaluates `policy`, which was trained with `config` on the robots of these servers, or in this process if there are
/// none. Returns the evaluation as JSON and as a table.
///
/// The robots are fresh ones of the server, or of the training's model with default commands and physics. Jumps, the
/// attitude and getting up are evaluated in this process only.
pub fn evaluate_trained(
    policy: &Policy,
    config: &TrainConfig,
    endpoints: &[String],
    observer: &Observer,
) -> Result<(String, String), Failure> {
    let json = |evaluation: serde_json::Result<String>| evaluation.expect("an evaluation is plain data");
    let text = |table: String| {
        let of = "Simulated here, with the model and the targets of this command; those of the servers may differ.\n";
        if endpoints.is_empty() { table } else { of.to_owned() + &table }
    };
    if let TaskConfig::Jump(task) = &config.task {
        let targets = jumps(policy, config, task, observer)?;
        let rows = [nominal(ByTarget { targets })];
        let table = measure_tables::jumps(ROBOTS as u32, &rows);
        return Ok((json(serde_json::to_string_pretty(&rows[0].found.targets)), text(table)));
    }
    if let TaskConfig::Attitude(_) = &config.task {
        let errors = attitude(policy, config, observer)?;
        let rows = [nominal(errors)];
        let table = measure_tables::attitude(ROBOTS as u32, RUN.seconds, &rows);
        return Ok((json(serde_json::to_string_pretty(&rows[0].found)), text(table)));
    }
    if let TaskConfig::Getup(_) = &config.task {
        let rows = [nominal(getup(policy, config, observer)?)];
        let table = measure_tables::getup(ROBOTS as u32, &rows);
        return Ok((json(serde_json::to_string_pretty(&rows[0].found)), text(table)));
    }
    if let TaskConfig::Pose(_) = &config.task {
        let errors = pose(policy, config, observer)?;
        let table = measure_tables::pose(ROBOTS, RUN.seconds, &errors);
        return Ok((json(serde_json::to_string_pretty(&errors)), text(table)));
    }
    let evaluation = walking(policy, config, endpoints, observer)?;
    Ok((json(serde_json::to_string_pretty(&evaluation)), evaluation_text(&evaluation)))
}

/// Returns a row of the nominal robot.
fn nominal<T>(found: T) -> Row<T> {
    Row { condition: "nominal", engine: Engine::Batch, found }
}

/// Measures what the policy does on fresh robots of this process.
fn measured<M: Measure>(
    policy: &Policy,
    config: &TrainConfig,
    run: Run,
    observer: &Observer,
    new: impl Fn(&EnvSpec, usize) -> Result<M, MeasureError>,
) -> Result<M::Found, Failure> {
    measured_on(policy, config.envs(ROBOTS, 1, 0)?.remove(0).as_mut(), run, observer, new)
}

fn measured_on<M: Measure>(
    policy: &Policy,
    env: &mut dyn VecEnv,
    run: Run,
    observer: &Observer,
    new: impl Fn(&EnvSpec, usize) -> Result<M, MeasureError>,
) -> Result<M::Found, Failure> {
    let new = new(env.spec(), env.num_envs()).map_err(other)?;
    measure(policy, env, new, run, |_| observer.check().is_ok()).map_err(|error| match error {
        MeasureError::Stopped => Failure::Interrupted,
        _ => other(error),
    })
}

fn walking(
    policy: &Policy,
    config: &TrainConfig,
    endpoints: &[String],
    observer: &Observer,
) -> Result<Evaluation, Failure> {
    let fresh = fresh(config, config.task.with_default_settings());
    // The task of servers may need what this process lacks, such as actuator networks.
    let robot = self::fresh(config, TaskConfig::Walk(WalkConfig::default())).robots(1)?.control();
    let new = |spec: &EnvSpec, robots| Walking::new(spec, robots, &robot.feet, &robot.torque_limits);
    if endpoints.is_empty() {
        return measured(policy, &fresh, RUN, observer, new);
    }
    let mut env = remote_env(endpoints, ROBOTS)?;
    let evaluation = measured_on(policy, &mut env, RUN, observer, new)?;
    env.close().map_err(other)?;
    Ok(evaluation)
}

fn jumps(
    policy: &Policy,
    config: &TrainConfig,
    trained: &JumpConfig,
    observer: &Observer,
) -> Result<Vec<Landings>, Failure> {
    let to_target = |task: JumpConfig| {
        let fresh = fresh(config, TaskConfig::Jump(task.clone()));
        let robot = fresh.quadruped()?;
        let new = |spec: &EnvSpec, robots| Ok(Jumping::new(spec, robots, &robot, &task));
        measured(policy, &fresh, Run { seconds: JUMP_S, ..RUN }, observer, new)
    };
    Jumping::tasks(trained).into_iter().map(to_target).collect()
}

fn attitude(policy: &Policy, config: &TrainConfig, observer: &Observer) -> Result<AttitudeErrors, Failure> {
    let fresh = fresh(config, TaskConfig::Attitude(AttitudeFollowing::task()));
    measured(policy, &fresh, RUN, observer, |spec, _| AttitudeFollowing::new(spec))
}

fn getup(policy: &Policy, config: &TrainConfig, observer: &Observer) -> Result<GettingUpTimes, Failure> {
    let fresh = fresh(config, TaskConfig::Getup(GettingUp::task()));
    let standing_height = fresh.robots(1)?.control().standing_height.expect("a quadruped stands");
    let run = Run { seconds: GETUP_S, ..RUN };
    measured(policy, &fresh, run, observer, |spec, robots| GettingUp::new(spec, robots, standing_height))
}

fn pose(policy: &Policy, config: &TrainConfig, observer: &Observer) -> Result<PoseErrors, Failure> {
    let fresh = fresh(config, config.task.with_default_settings());
    measured(policy, &fresh, RUN, observer, |spec, _| PoseFollowing::new(spec))
}

/// Returns the training's robot with default physics.
fn fresh(config: &TrainConfig, task: TaskConfig) -> TrainConfig {
    let (model, control) = (config.model.clone(), config.control.clone());
    TrainConfig { model, control, task, sim: SimConfig::default(), ..TrainConfig::default() }
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
