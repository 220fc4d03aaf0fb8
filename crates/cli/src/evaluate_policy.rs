//! `twinstep evaluate-policy`: velocity errors, falls and gait of a policy, on engines and robots that it has not seen.

use std::fmt::Write;
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use twinstep_envs::{ControlledRobot, JumpConfig, ObservationNoise, Randomisation, TaskConfig};
use twinstep_learning::{Evaluation, EvaluationError, EvaluationPlan, SpeedBin, evaluate};
use twinstep_model::{EnvError, EnvSpec, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_report::film_strip;
use twinstep_sim::{Engine, RoughTerrain, SimConfig, StepTerrain, Terrain};

use crate::evaluate_attitude::{self, AttitudeRow};
use crate::evaluate_gait::{self, GaitRow};
use crate::evaluate_jump::{self, JumpRow};
use crate::evaluate_tracking::{self, TrackingRow};
use crate::exit::{CommandResult, Failure, Signals, input};
use crate::serve::engine;
use crate::train_config::TrainConfig;

/// Frames of the film strip, and policy steps between two of them.
const FILM_FRAMES: usize = 15;
const FILM_STEPS: usize = 4;

/// Evaluate a policy: velocity errors, falls and gait, on engines and robots that it has not seen.
///
/// The mean action of the policy steps fresh robots with the default commands of `walk`: a new one every 5 s. A policy of
/// `track` follows a circle, a figure of eight and a square, with and without motion capture. A policy of `gait` is
/// commanded a trot, a pace, a bound and a pronk, under nominal, robots, pushes and delay. A policy of `attitude` follows
/// sines of roll, pitch and height. A policy of `jump` jumps once to both ends and the middle of the ranges of its targets, or to its only target. A robot that has fallen no longer counts for the errors,
/// but its landing before the fall does. Conditions:
///
///   nominal   the robot of the model file on flat ground
///   robots    masses +-15 %, friction 0.4 to 1.25, gains +-10 %
///   ground    random heights of up to 3 cm
///   steps     level treads of 30 cm with steps of 3 cm between them
///   pushes    0.5 m/s in a random direction, every 5 to 10 s
///   delay     commands arrive 0 to 20 ms late
///   noise     errors of the sensors as in Isaac Lab
///   robust    robots, steps, pushes and delay at once
///
/// Without --engine the nominal robot is also simulated in rapier, which no policy is trained in. `--engine mujoco`
/// needs `pip install "twinstep[mujoco]"` and simulates a thousand env-steps per second.
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
    /// Evaluate under these conditions only; repeat it for several. Default: all.
    #[arg(long, value_name = "NAME", value_parser = CONDITIONS)]
    condition: Vec<String>,
    /// Number of robots.
    #[arg(long, value_name = "N", default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    robots: u32,
    /// Simulated time of each robot [s]. A jump takes 3 s.
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of robots and commands.
    #[arg(long, default_value_t = 1_000_000)]
    seed: u64,
    /// Write a film strip (SVG) of a robot with the first condition, 0.08 s between two frames.
    #[arg(long, value_name = "FILE")]
    film: Option<PathBuf>,
    /// Print one JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// Names of the conditions.
const CONDITIONS: [&str; 8] = ["nominal", "robots", "pushes", "noise", "ground", "steps", "delay", "robust"];

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
    let first = engine.unwrap_or(Engine::Batch);
    let calm = Randomisation::default();
    let condition = |name, randomise| Condition { name, engine: first, randomise, terrain: Terrain::Flat };
    let robots = Randomisation {
        mass_scale: [0.85, 1.15],
        // The nominal coefficient of friction is 0.8.
        friction_scale: [0.4 / 0.8, 1.25 / 0.8],
        kp_scale: [0.9, 1.1],
        kd_scale: [0.9, 1.1],
        ..calm
    };
    let push_m_s = [0.5, 0.5];
    let noise = ObservationNoise {
        angular_velocity_rad_s: 0.2,
        gravity: 0.05,
        joint_position_rad: 0.01,
        joint_velocity_rad_s: 1.5,
        ..ObservationNoise::default()
    };
    let mut conditions = vec![
        condition("nominal", calm),
        condition("robots", robots),
        condition("pushes", Randomisation { push_m_s, ..calm }),
        condition("noise", Randomisation { noise, ..calm }),
    ];
    if engine.is_none() {
        conditions.insert(1, Condition { engine: Engine::Rapier, ..condition("nominal", calm) });
    }
    let ground = Terrain::Rough(RoughTerrain { height_m: 0.03, cell_m: 0.3, size_m: 40.0, seed: 1 });
    let steps = Terrain::Steps(StepTerrain { height_m: 0.03, tread_m: 0.3, size_m: 20.0, seed: 1 });
    let command_delay_ms = [0.0, 20.0];
    let robust = Randomisation { push_m_s, command_delay_ms, ..robots };
    conditions.extend([
        Condition { terrain: ground, ..condition("ground", calm) },
        Condition { terrain: steps, ..condition("steps", calm) },
        condition("delay", Randomisation { command_delay_ms, ..calm }),
        Condition { terrain: steps, ..condition("robust", robust) },
    ]);
    conditions
}

impl Args {
    /// Returns the conditions that are wanted.
    fn conditions(&self) -> Vec<Condition> {
        let is_wanted = |condition: &Condition| self.condition.iter().any(|name| name == condition.name);
        conditions(self.engine).into_iter().filter(|one| self.condition.is_empty() || is_wanted(one)).collect()
    }
}

impl Condition {
    /// Creates `robots` robots.
    fn env(&self, args: &Args, task: TaskConfig, robots: usize) -> Result<Box<dyn VecEnv>, Failure> {
        let sim = SimConfig { engine: self.engine, terrain: self.terrain, ..SimConfig::default() };
        let (model, randomise) = (args.model.clone(), self.randomise);
        let config = TrainConfig { model, task, sim, randomise, ..TrainConfig::default() };
        Ok(config.envs(robots, 1, 0)?.remove(0))
    }
}

/// Evaluates the policy under each condition.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    if !(args.seconds >= 1.0 && args.seconds <= 3600.0) {
        return Err(Failure::Input(miette::miette!("`--seconds` = {} is not allowed: 1 to 3600 s", args.seconds)));
    }
    let (policy, header) = Policy::read(&args.policy).map_err(input)?;
    let task = task(&policy, &header.origin.config);
    if let Some(path) = &args.film {
        let mut env = args.conditions()[0].env(args, task.clone(), 1)?;
        check_spec(&policy, env.spec())?;
        let film = film(&policy, env.as_mut(), args.seed).map_err(input)?;
        twinstep_files::write(path, film).map_err(|cause| {
            Failure::Input(miette::miette!("`--film` = {}: cannot write the file: {cause}", path.display()))
        })?;
    }
    let text = match &task {
        TaskConfig::Track(_) => {
            let rows = tracking(args, &policy, &signals)?;
            if args.json { json(args, &rows) } else { evaluate_tracking::table(args.robots, args.seconds, &rows) }
        }
        TaskConfig::Jump(trained) => {
            let rows = jumping(args, &policy, trained, &signals)?;
            if args.json { json(args, &rows) } else { evaluate_jump::table(args.robots, &rows) }
        }
        TaskConfig::Gait(_) => {
            let rows = gaits(args, &policy, &signals)?;
            if args.json { json(args, &rows) } else { evaluate_gait::table(args.robots, args.seconds, &rows) }
        }
        TaskConfig::Attitude(_) => {
            let rows = attitudes(args, &policy, &signals)?;
            if args.json { json(args, &rows) } else { evaluate_attitude::table(args.robots, args.seconds, &rows) }
        }
        _ => {
            let rows = walking(args, &policy, &signals)?;
            if args.json {
                json(args, &rows)
            } else {
                format!("{}\n{}", table(args, &rows), speed_table(&rows[0].evaluation))
            }
        }
    };
    print!("{text}");
    Ok(())
}

/// Returns the task of a policy: that of `jump` with the targets of its training, and the others with default settings.
fn task(policy: &Policy, trained_with: &str) -> TaskConfig {
    let trained = TrainConfig::parse(trained_with, "the policy's config").map(|config| config.task);
    match (policy.spec.task.as_str(), trained) {
        ("jump", Ok(task @ TaskConfig::Jump(_))) => task,
        (name, _) => TaskConfig::named(name).unwrap_or_default(),
    }
}

fn json(args: &Args, rows: &impl Serialize) -> String {
    format!("{}\n", serde_json::json!({ "policy": args.policy, "rows": rows }))
}

/// Evaluates the policy by velocity commands under each condition.
fn walking(args: &Args, policy: &Policy, signals: &Signals) -> Result<Vec<Row>, Failure> {
    let robot = TrainConfig { model: args.model.clone(), ..TrainConfig::default() }.robots(1)?.control();
    let ControlledRobot { feet, torque_limits, .. } = &robot;
    let plan = EvaluationPlan { feet, torque_limits, seconds: args.seconds, seed: args.seed };
    let mut rows = Vec::new();
    for condition in args.conditions() {
        let mut env = condition.env(args, TaskConfig::default(), args.robots as usize)?;
        let Condition { name, engine, .. } = condition;
        let bar = progress_bar(name);
        let proceed = |share: f64| show(&bar, share, signals);
        let evaluation = evaluate(policy, env.as_mut(), plan, proceed).map_err(|error| match error {
            EvaluationError::Stopped => Failure::Interrupted,
            _ => input(error),
        })?;
        bar.finish_and_clear();
        rows.push(Row { condition: name, engine, evaluation });
    }
    Ok(rows)
}

/// Evaluates the policy along each path under each condition.
fn tracking(args: &Args, policy: &Policy, signals: &Signals) -> Result<Vec<TrackingRow>, Failure> {
    let mut rows = Vec::new();
    for condition in args.conditions() {
        let Condition { name, engine, .. } = condition;
        let bar = progress_bar(name);
        // The drift without motion capture is shown once an engine.
        let without = evaluate_tracking::tasks(false).into_iter().filter(|_| name == "nominal");
        let tasks: Vec<_> = evaluate_tracking::tasks(true).into_iter().chain(without).collect();
        let mut paths = Vec::new();
        for (index, task) in tasks.iter().enumerate() {
            let mut env = condition.env(args, TaskConfig::Track(task.0.clone()), args.robots as usize)?;
            check_spec(policy, env.spec())?;
            let proceed = |share: f64| show(&bar, (index as f64 + share) / tasks.len() as f64, signals);
            let duration_and_seed = (args.seconds, args.seed);
            let errors = evaluate_tracking::evaluate(policy, env.as_mut(), task, duration_and_seed, proceed);
            paths.push(errors.map_err(input)?.ok_or(Failure::Interrupted)?);
        }
        bar.finish_and_clear();
        rows.push(TrackingRow { condition: name, engine, paths });
    }
    Ok(rows)
}

/// Evaluates how the policy follows each gait, under the conditions of gaits.
fn gaits(args: &Args, policy: &Policy, signals: &Signals) -> Result<Vec<GaitRow>, Failure> {
    let tasks = evaluate_gait::tasks();
    let mut rows = Vec::new();
    let conditions = conditions(args.engine).into_iter();
    for condition in conditions.filter(|condition| evaluate_gait::CONDITIONS.contains(&condition.name)) {
        let Condition { name, engine, .. } = condition;
        let bar = progress_bar(name);
        let mut gaits = Vec::new();
        for (index, (task, gait)) in tasks.iter().enumerate() {
            let mut env = condition.env(args, TaskConfig::Gait(task.clone()), args.robots as usize)?;
            check_spec(policy, env.spec())?;
            let proceed = |share: f64| show(&bar, (index as f64 + share) / tasks.len() as f64, signals);
            let motion = evaluate_gait::evaluate(policy, env.as_mut(), *gait, (args.seconds, args.seed), proceed);
            gaits.push(motion.map_err(input)?.ok_or(Failure::Interrupted)?);
        }
        bar.finish_and_clear();
        rows.push(GaitRow { condition: name, engine, gaits });
    }
    Ok(rows)
}

/// Evaluates the attitude of the base under each condition.
fn attitudes(args: &Args, policy: &Policy, signals: &Signals) -> Result<Vec<AttitudeRow>, Failure> {
    let mut rows = Vec::new();
    for condition in args.conditions() {
        let mut env = condition.env(args, TaskConfig::Attitude(evaluate_attitude::task()), args.robots as usize)?;
        check_spec(policy, env.spec())?;
        let Condition { name, engine, .. } = condition;
        let bar = progress_bar(name);
        let proceed = |share: f64| show(&bar, share, signals);
        let errors = evaluate_attitude::evaluate(policy, env.as_mut(), (args.seconds, args.seed), proceed);
        let errors = errors.map_err(input)?.ok_or(Failure::Interrupted)?;
        bar.finish_and_clear();
        rows.push(AttitudeRow { condition: name, engine, errors });
    }
    Ok(rows)
}

/// Evaluates the landings of the policy under each condition.
fn jumping(args: &Args, policy: &Policy, trained: &JumpConfig, signals: &Signals) -> Result<Vec<JumpRow>, Failure> {
    let robot = TrainConfig { model: args.model.clone(), ..TrainConfig::default() }.quadruped()?;
    let tasks = evaluate_jump::tasks(trained);
    let mut rows = Vec::new();
    // A jump is over before the first push.
    for condition in args.conditions().into_iter().filter(|condition| condition.name != "pushes") {
        let Condition { name, engine, .. } = condition;
        let bar = progress_bar(name);
        let mut targets = Vec::new();
        for (index, task) in tasks.iter().enumerate() {
            let mut env = condition.env(args, TaskConfig::Jump(task.clone()), args.robots as usize)?;
            check_spec(policy, env.spec())?;
            let proceed = |share: f64| show(&bar, (index as f64 + share) / tasks.len() as f64, signals);
            let landings = evaluate_jump::evaluate(policy, env.as_mut(), &robot, task, args.seed, proceed);
            targets.push(landings.map_err(input)?.ok_or(Failure::Interrupted)?);
        }
        bar.finish_and_clear();
        rows.push(JumpRow { condition: name, engine, targets });
    }
    Ok(rows)
}

/// Fails unless the policy is one of the environments' task and robot.
pub fn check_spec(policy: &Policy, env: &EnvSpec) -> CommandResult {
    if policy.spec.hash() == env.hash() {
        return Ok(());
    }
    Err(input(EvaluationError::OtherSpec { policy: policy.spec.hash(), env: env.hash() }))
}

fn progress_bar(name: &'static str) -> ProgressBar {
    ProgressBar::new(100).with_message(name).with_style(
        ProgressStyle::with_template("{msg:10} {bar:32} {pos} %  ETA {eta}").expect("the template is valid"),
    )
}

/// Shows the share that is done. Returns false if the user has interrupted.
fn show(bar: &ProgressBar, share: f64, signals: &Signals) -> bool {
    bar.set_position((100.0 * share) as u64);
    matches!(signals.check(), Ok(false))
}

/// Returns the evaluations as a table.
fn table(args: &Args, rows: &[Row]) -> String {
    let mut text = format!(
        "{} robots, {} s, new command every 5 s. Errors: RMS (from 1 s after each new command)\n\n\
         condition  engine   up       velocity [m/s]  yaw rate [rad/s]  swing    duty  slip       power\n",
        args.robots, args.seconds
    );
    for Row { condition, engine, evaluation: e } in rows {
        let engine = format!("{engine:?}").to_lowercase();
        let _ = writeln!(
            text,
            "{condition:10} {engine:8} {:5.1} %  {:.3} ({:.3})   {:.3} ({:.3})     {:.1} cm  {:.2}  {:.3} m/s  {:3.0} W",
            100.0 * e.up,
            e.velocity_rms,
            e.settled_velocity_rms,
            e.yaw_rate_rms,
            e.settled_yaw_rate_rms,
            100.0 * e.swing_height,
            e.duty_factor,
            e.slip_speed,
            e.power,
        );
    }
    text
}

/// Returns the errors of an evaluation by the commanded speed.
fn speed_table(evaluation: &Evaluation) -> String {
    let mut text = "First row by commanded speed:\nspeed [m/s]  share  velocity [m/s]  yaw rate [rad/s]\n".to_owned();
    for (index, SpeedBin { from, share, velocity_rms, yaw_rate_rms }) in evaluation.by_speed.iter().enumerate() {
        let to = evaluation.by_speed.get(index + 1).map_or(String::new(), |next| next.from.to_string());
        let range = format!("{from} to {to}");
        let _ = writeln!(text, "{range:11} {:4.0} %  {velocity_rms:.3}           {yaw_rate_rms:.3}", 100.0 * share);
    }
    text
}

/// Returns a film strip of the first robot of `env` under the mean action of `policy`.
fn film(policy: &Policy, env: &mut dyn VecEnv, seed: u64) -> Result<String, EnvError> {
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, env.num_envs()))?.to_vec();
    let mut actions = vec![0.0; env.num_envs() * env.spec().action_len()];
    let mut frames = Vec::new();
    for step in 0..FILM_FRAMES * FILM_STEPS {
        if step % FILM_STEPS == 0 {
            frames.push((step as f64 * env.spec().policy_dt, env.scene(0)?));
        }
        runner.run(&obs, &mut actions);
        obs.copy_from_slice(&env.step(&actions)?.obs);
    }
    Ok(film_strip(&frames))
}
