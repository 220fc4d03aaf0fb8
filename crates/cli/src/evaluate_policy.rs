//! `twinstep evaluate-policy`: velocity errors, falls and gait of a policy, on engines and robots that it has not seen.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use twinstep_agent::read_contract;
use twinstep_effects::ControlTable;
use twinstep_envs::{ControlledRobot, Gait, JumpConfig, Randomisation, TaskConfig, TrackConfig, WalkConfig};
use twinstep_measures::{
    AttitudeErrors, AttitudeFollowing, CONDITION_NAMES, Condition, CourseWalking, Evaluation, GaitFollowing, JUMP_S,
    Jumping, KindOfGround, Measure, MeasureError, Run, Tracking, Walking, check_spec, conditions, measure,
};
use twinstep_model::{EnvError, EnvSpec, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_report::film_strip;
use twinstep_sim::{CourseTerrain, Engine, SimConfig, Terrain};

use crate::exit::{CommandResult, Failure, Signals, input};
use crate::measure_tables::{self, ByGait, ByPath, ByTarget, Row};
use crate::serve::engine;
use crate::train_config::TrainConfig;

/// Frames of the film strip, and policy steps between two of them.
const FILM_FRAMES: usize = 15;
const FILM_STEPS: usize = 4;

/// Evaluate a policy: velocity errors, falls and gait, on engines and robots that it has not seen.
///
/// The mean action of the policy steps fresh robots with the default commands of `walk`: a new one
/// every 5 s. A policy of `track` follows a circle, a figure of eight and a square, with and
/// without motion capture. A policy of `gait` is commanded a trot, a pace, a bound and a pronk,
/// under nominal, robots, pushes and delay. A policy of `attitude` follows sines of roll, pitch and
/// height. A policy of `jump` jumps once to both ends and the middle of the ranges of its targets,
/// or to its only target. A robot that has fallen no longer counts for the errors, but its landing
/// before the fall does. Conditions:
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
/// --course shows how steep and high a ground a policy of `walk` masters instead: slopes, stairs,
/// obstacles, waves and rough ground at ten levels each. Every robot starts in the middle of a
/// patch of 8 m and walks on at 0.8 m/s, while it turns to a random heading; the table has the share
/// that arrive at its border. Gains and action scale are those of the policy, without --model.
///
/// Without --engine the nominal robot is also simulated in rapier, which no policy is trained in.
/// `--engine mujoco` needs `pip install "twinstep[mujoco]"` and simulates a thousand env-steps per
/// second.
///
/// Examples: `twinstep evaluate-policy walk/policy.safetensors` and `twinstep evaluate-policy
/// walk/policy.safetensors --engine mujoco --robots 64`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
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
    #[arg(long, value_name = "NAME", value_parser = CONDITION_NAMES)]
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
    /// Walk over slopes, stairs, obstacles, waves and rough ground instead.
    #[arg(long, conflicts_with_all = ["condition", "seconds", "film"])]
    course: bool,
    /// Print one JSON object on stdout.
    #[arg(long)]
    json: bool,
}

impl Args {
    /// Returns gains, default pose and action scale of the policy for the ideal Go2; a model file has its own.
    fn contract(&self) -> Option<ControlTable> {
        if self.model.is_some() { None } else { read_contract(&self.policy).ok() }
    }

    /// Returns the conditions that are wanted.
    fn conditions(&self) -> Vec<Condition> {
        let is_wanted = |condition: &Condition| self.condition.iter().any(|name| name == condition.name);
        conditions(self.engine).into_iter().filter(|one| self.condition.is_empty() || is_wanted(one)).collect()
    }
}

/// Creates `robots` robots under a condition.
fn env(condition: &Condition, args: &Args, task: TaskConfig, robots: usize) -> Result<Box<dyn VecEnv>, Failure> {
    let sim = SimConfig { engine: condition.engine, terrain: condition.terrain, ..SimConfig::default() };
    let (model, randomise) = (args.model.clone(), condition.randomise);
    let config = TrainConfig { model, task, sim, randomise, control: args.contract(), ..TrainConfig::default() };
    Ok(config.envs(robots, 1, 0)?.remove(0))
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
        let mut env = env(&args.conditions()[0], args, task.clone(), 1)?;
        check_spec(&policy, env.spec()).map_err(input)?;
        let film = film(&policy, env.as_mut(), args.seed).map_err(input)?;
        twinstep_files::write(path, film).map_err(|cause| {
            Failure::Input(miette::miette!("`--film` = {}: cannot write the file: {cause}", path.display()))
        })?;
    }
    let who = (args, &policy, &signals);
    let text = match &task {
        TaskConfig::Walk(trained) if args.course => {
            let kinds = course(who, trained)?;
            if args.json { json(args, &kinds) } else { measure_tables::course(&kinds) }
        }
        other if args.course => {
            return Err(Failure::Input(miette::miette!(
                "`--course` is for policies of `walk`, and this is one of `{}`",
                other.name()
            )));
        }
        TaskConfig::Track(_) => {
            let rows = tracking(who)?;
            if args.json { json(args, &rows) } else { measure_tables::tracking(args.robots, args.seconds, &rows) }
        }
        TaskConfig::Jump(trained) => {
            let rows = jumping(who, trained)?;
            if args.json { json(args, &rows) } else { measure_tables::jumps(args.robots, &rows) }
        }
        TaskConfig::Gait(_) => {
            let rows = gaits(who)?;
            if args.json { json(args, &rows) } else { measure_tables::gaits(args.robots, args.seconds, &rows) }
        }
        TaskConfig::Attitude(_) => {
            let rows = attitudes(who)?;
            if args.json { json(args, &rows) } else { measure_tables::attitude(args.robots, args.seconds, &rows) }
        }
        task => {
            let rows = walking(who, task)?;
            if args.json {
                json(args, &rows)
            } else {
                let table = measure_tables::walking(args.robots, args.seconds, &rows);
                format!("{table}\n{}", measure_tables::by_speed(&rows[0].found))
            }
        }
    };
    print!("{text}");
    Ok(())
}

/// Returns the task of a policy: that of `jump` with the targets of its training, and the others with default settings, but for
/// what they observe.
fn task(policy: &Policy, trained_with: &str) -> TaskConfig {
    let trained = TrainConfig::parse(trained_with, "the policy's config").map(|config| config.task);
    match (policy.spec.task.as_str(), trained) {
        ("jump", Ok(task @ TaskConfig::Jump(_))) => task,
        _ => TaskConfig::of_policy(&policy.spec).unwrap_or_default(),
    }
}

fn json(args: &Args, rows: &impl Serialize) -> String {
    format!("{}\n", serde_json::json!({ "policy": args.policy, "rows": rows }))
}

/// Measures what the policy does in several tasks under each condition. `measure` is that of a task on an environment.
fn measured<T, M: Measure>(
    (args, policy, signals): Who,
    conditions: &[Condition],
    tasks: &dyn Fn(&Condition) -> Vec<(TaskConfig, T)>,
    run: Run,
    new: impl Fn(&EnvSpec, usize, &T) -> Result<M, MeasureError>,
) -> Result<Vec<Row<Vec<M::Found>>>, Failure> {
    let mut rows = Vec::new();
    for condition in conditions {
        let bar = progress_bar(condition.name);
        let tasks = tasks(condition);
        let mut found = Vec::new();
        for (index, (config, task)) in tasks.iter().enumerate() {
            let mut env = env(condition, args, config.clone(), args.robots as usize)?;
            let new = new(env.spec(), env.num_envs(), task).map_err(input)?;
            let proceed = |share: f64| show(&bar, (index as f64 + share) / tasks.len() as f64, signals);
            found.push(measure(policy, env.as_mut(), new, run, proceed).map_err(failure)?);
        }
        bar.finish_and_clear();
        rows.push(Row { condition: condition.name, engine: condition.engine, found });
    }
    Ok(rows)
}

/// Returns what stopped a measurement.
fn failure(error: MeasureError) -> Failure {
    match error {
        MeasureError::Stopped => Failure::Interrupted,
        _ => input(error),
    }
}

/// Returns rows whose measurements have another form.
fn mapped<T, U>(rows: Vec<Row<T>>, of: impl Fn(T) -> U) -> Vec<Row<U>> {
    rows.into_iter().map(|Row { condition, engine, found }| Row { condition, engine, found: of(found) }).collect()
}

type Who<'a> = (&'a Args, &'a Policy, &'a Signals);

fn run_of(args: &Args) -> Run {
    Run { seconds: args.seconds, seed: args.seed }
}

/// Evaluates the policy by velocity commands under each condition.
fn walking(who: Who, task: &TaskConfig) -> Result<Vec<Row<Evaluation>>, Failure> {
    let args = who.0;
    let robot = TrainConfig { model: args.model.clone(), control: args.contract(), ..TrainConfig::default() };
    let robot = robot.robots(1)?.control();
    let ControlledRobot { feet, torque_limits, .. } = &robot;
    let tasks = |_: &Condition| vec![(task.clone(), ())];
    let new = |spec: &EnvSpec, robots: usize, (): &()| Walking::new(spec, robots, feet, torque_limits);
    Ok(mapped(measured(who, &args.conditions(), &tasks, run_of(args), new)?, |mut found| found.remove(0)))
}

/// Evaluates the policy on a course.
fn course(who: Who, trained: &WalkConfig) -> Result<Vec<KindOfGround>, Failure> {
    let (args, terrain) = (who.0, CourseTerrain::FULL);
    let condition = Condition {
        name: "course",
        engine: args.engine.unwrap_or(Engine::Batch),
        randomise: Randomisation::default(),
        terrain: Terrain::Course(terrain),
    };
    let tasks = |_: &Condition| vec![(TaskConfig::Walk(CourseWalking::task(trained)), ())];
    let new = |_: &EnvSpec, robots: usize, (): &()| Ok(CourseWalking::new(terrain, robots));
    let run = Run { seconds: CourseWalking::SECONDS, ..run_of(args) };
    Ok(measured(who, &[condition], &tasks, run, new)?.remove(0).found.remove(0))
}

/// Evaluates the policy along each path under each condition.
fn tracking(who: Who) -> Result<Vec<Row<ByPath>>, Failure> {
    let tasks = |condition: &Condition| {
        // The drift without motion capture is shown once an engine.
        let without = Tracking::tasks(false).into_iter().filter(|_| condition.name == "nominal");
        let all = Tracking::tasks(true).into_iter().chain(without);
        all.map(|task| (TaskConfig::Track(task.clone()), task)).collect()
    };
    let new = |spec: &EnvSpec, _, task: &TrackConfig| Ok(Tracking::new(spec, task));
    Ok(mapped(measured(who, &who.0.conditions(), &tasks, run_of(who.0), new)?, |paths| ByPath { paths }))
}

/// Evaluates how the policy follows each gait, under the conditions of gaits.
fn gaits(who: Who) -> Result<Vec<Row<ByGait>>, Failure> {
    let mut wanted = conditions(who.0.engine);
    wanted.retain(|condition| GaitFollowing::CONDITIONS.contains(&condition.name));
    let tasks = |_: &Condition| GaitFollowing::tasks().map(|(task, gait)| (TaskConfig::Gait(task), gait)).to_vec();
    let new = |spec: &EnvSpec, robots: usize, gait: &Gait| GaitFollowing::new(spec, robots, *gait);
    Ok(mapped(measured(who, &wanted, &tasks, run_of(who.0), new)?, |gaits| ByGait { gaits }))
}

/// Evaluates the attitude of the base under each condition.
fn attitudes(who: Who) -> Result<Vec<Row<AttitudeErrors>>, Failure> {
    let tasks = |_: &Condition| vec![(TaskConfig::Attitude(AttitudeFollowing::task()), ())];
    let new = |spec: &EnvSpec, _, (): &()| AttitudeFollowing::new(spec);
    Ok(mapped(measured(who, &who.0.conditions(), &tasks, run_of(who.0), new)?, |mut found| found.remove(0)))
}

/// Evaluates the landings of the policy under each condition.
fn jumping(who: Who, trained: &JumpConfig) -> Result<Vec<Row<ByTarget>>, Failure> {
    let args = who.0;
    let robot = TrainConfig { model: args.model.clone(), ..TrainConfig::default() }.quadruped()?;
    let mut wanted = args.conditions();
    // A jump is over before the first push.
    wanted.retain(|condition| condition.name != "pushes");
    let tasks = |_: &Condition| {
        let all = Jumping::tasks(trained).into_iter();
        all.map(|task| (TaskConfig::Jump(task.clone()), task)).collect()
    };
    let new = |spec: &EnvSpec, robots: usize, task: &JumpConfig| Ok(Jumping::new(spec, robots, &robot, task));
    let run = Run { seconds: JUMP_S, ..run_of(args) };
    Ok(mapped(measured(who, &wanted, &tasks, run, new)?, |targets| ByTarget { targets }))
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
