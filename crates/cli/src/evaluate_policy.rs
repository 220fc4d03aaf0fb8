//! `twinstep evaluate-policy`: velocity errors, falls and gait of a policy, on engines and robots that it has not seen.

use std::fmt::Write;
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use twinstep_envs::Randomisation;
use twinstep_learning::{Evaluation, EvaluationError, EvaluationPlan, evaluate};
use twinstep_policy::Policy;
use twinstep_sim::{Engine, RoughTerrain, SimConfig, Terrain};

use crate::exit::{CommandResult, Failure, Signals, input};
use crate::robot_file::robot_model;
use crate::serve::engine;
use crate::train_config::TrainConfig;

/// Evaluate a policy: velocity errors, falls and gait, on engines and robots that it has not seen.
///
/// The mean action of the policy steps fresh robots with the default commands of `walk`: a new one every 5 s. A robot
/// that has fallen no longer counts for the errors. Conditions:
///
///   nominal   the robot of the model file on flat ground
///   robots    masses +-15 %, friction 0.4 to 1.25, gains +-10 %
///   ground    random heights of up to 3 cm
///
/// Without --engine the nominal robot is also simulated in rapier, which no policy is trained in. `--engine mujoco`
/// needs `pip install "twinstep[mujoco]"` and simulates a thousand env-steps per second, without rough ground.
///
/// Examples: `twinstep evaluate-policy walk/policy.safetensors` and
/// `twinstep evaluate-policy walk/policy.safetensors --engine mujoco --robots 64`
#[derive(clap::Args)]
pub struct Args {
    /// Policy file (safetensors).
    policy: PathBuf,
    /// Model file of the robot. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Physics engine of all conditions. Default: batch, and rapier for the nominal robot.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Number of robots.
    #[arg(long, value_name = "N", default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    robots: u32,
    /// Simulated time of each robot [s].
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of robots and commands.
    #[arg(long, default_value_t = 1_000_000)]
    seed: u64,
    /// Print one JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// What the robots are like in an evaluation.
struct Condition {
    name: &'static str,
    engine: Engine,
    randomise: Randomisation,
    terrain: Terrain,
}

/// Evaluation under a condition.
#[derive(Serialize)]
struct Row {
    condition: &'static str,
    engine: Engine,
    #[serde(flatten)]
    evaluation: Evaluation,
}

fn conditions(engine: Option<Engine>) -> Vec<Condition> {
    let nominal =
        |engine| Condition { name: "nominal", engine, randomise: Randomisation::default(), terrain: Terrain::Flat };
    let first = engine.unwrap_or(Engine::Batch);
    let randomise = Randomisation {
        mass_scale: [0.85, 1.15],
        // The nominal coefficient of friction is 0.8.
        friction_scale: [0.4 / 0.8, 1.25 / 0.8],
        kp_scale: [0.9, 1.1],
        kd_scale: [0.9, 1.1],
        ..Randomisation::default()
    };
    let rough = Terrain::Rough(RoughTerrain { height_m: 0.03, cell_m: 0.3, size_m: 40.0, seed: 1 });
    let mut conditions = vec![nominal(first)];
    if engine.is_none() {
        conditions.push(nominal(Engine::Rapier));
    }
    conditions.push(Condition { name: "robots", randomise, ..nominal(first) });
    // MuJoCo does not simulate rough terrain of ours.
    if first != Engine::Mujoco {
        conditions.push(Condition { name: "ground", terrain: rough, ..nominal(first) });
    }
    conditions
}

/// Evaluates the policy under each condition.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    if !(args.seconds >= 1.0 && args.seconds <= 3600.0) {
        return Err(Failure::Input(miette::miette!("`--seconds` = {} is not allowed: 1 to 3600 s", args.seconds)));
    }
    let (policy, _) = Policy::read(&args.policy).map_err(input)?;
    let robot = robot_model(args.model.as_deref())?;
    let plan = EvaluationPlan { robot: &robot, seconds: args.seconds, seed: args.seed };
    let mut rows = Vec::new();
    for Condition { name, engine, randomise, terrain } in conditions(args.engine) {
        let sim = SimConfig { engine, terrain, ..SimConfig::default() };
        let config = TrainConfig { model: args.model.clone(), sim, randomise, ..TrainConfig::default() };
        let mut env = config.envs(args.robots as usize, 1, 0)?.remove(0);
        let bar = ProgressBar::new(100).with_message(name).with_style(
            ProgressStyle::with_template("{msg:10} {bar:32} {pos} %  ETA {eta}").expect("the template is valid"),
        );
        let proceed = |share: f64| {
            bar.set_position((100.0 * share) as u64);
            matches!(signals.check(), Ok(false))
        };
        let evaluation = evaluate(&policy, env.as_mut(), plan, proceed).map_err(|error| match error {
            EvaluationError::Stopped => Failure::Interrupted,
            _ => input(error),
        })?;
        bar.finish_and_clear();
        rows.push(Row { condition: name, engine, evaluation });
    }
    if args.json {
        println!("{}", serde_json::json!({ "policy": args.policy, "rows": rows }));
    } else {
        print!("{}", table(args, &rows));
    }
    Ok(())
}

/// Returns the evaluations as a table.
fn table(args: &Args, rows: &[Row]) -> String {
    let mut text = format!(
        "{} robots, {} s, new command every 5 s. Errors: RMS (from 1 s after each new command)\n\n\
         condition  engine   up       velocity [m/s]  yaw rate [rad/s]  swing    duty  slip\n",
        args.robots, args.seconds
    );
    for Row { condition, engine, evaluation: e } in rows {
        let engine = format!("{engine:?}").to_lowercase();
        let _ = writeln!(
            text,
            "{condition:10} {engine:8} {:5.1} %  {:.3} ({:.3})   {:.3} ({:.3})     {:.1} cm  {:.2}  {:.3} m/s",
            100.0 * e.up,
            e.velocity_rms,
            e.settled_velocity_rms,
            e.yaw_rate_rms,
            e.settled_yaw_rate_rms,
            100.0 * e.swing_height,
            e.duty_factor,
            e.slip_speed,
        );
    }
    text
}
