//! Evaluation of a policy, on engines and robots that it has not seen.

use std::path::PathBuf;

use indicatif::ProgressBar;
use serde::Serialize;
use twinstep_agent::read_contract;
use twinstep_effects::ControlTable;
use twinstep_envs::{ControlledRobot, Gait, JumpConfig, Randomisation, TaskConfig, TrackConfig, WalkConfig};
use twinstep_measures::{
    AttitudeErrors, AttitudeFollowing, Condition, CourseWalking, Evaluation, GETUP_S, GaitFollowing, GettingUp,
    GettingUpTimes, JUMP_S, Jumping, KindOfGround, Measure, MeasureError, Run, Tracking, Walking, check_spec,
    conditions, measure,
};
use twinstep_model::{EnvError, EnvSpec, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_report::film_strip;
use twinstep_sim::{CourseTerrain, Engine, SimConfig, Terrain};

use crate::failure::{Failure, input};
use crate::measure_tables::{self, ByGait, ByPath, ByTarget, Row};
use crate::observer::Observer;
use crate::train_config::TrainConfig;

/// Frames of the film strip, and policy steps between two of them.
const FILM_FRAMES: usize = 15;
const FILM_STEPS: usize = 4;

/// Settings of [`evaluate_policy`].
#[derive(Clone, Debug)]
pub struct EvaluatePolicyOptions {
    /// Policy file (safetensors).
    pub policy: PathBuf,
    /// Model file of the robot. `None`: the ideal Go2 with the gains of the policy.
    pub model: Option<PathBuf>,
    /// Physics engine of all conditions. `None`: batch, and rapier for the nominal robot.
    pub engine: Option<Engine>,
    /// Names of the conditions. Empty: all.
    pub conditions: Vec<String>,
    /// Course on which a policy of `walk` is evaluated instead, with the robots, delays and pushes of the only condition.
    pub course: Option<Course>,
    /// Number of robots.
    pub robots: u32,
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Seed of robots and commands.
    pub seed: u64,
    /// Film strip of a robot to write (SVG).
    pub film: Option<PathBuf>,
}

/// Course of patches over which robots walk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Course {
    /// Kinds and levels of its patches.
    pub terrain: CourseTerrain,
    /// Commanded velocity forward [m/s].
    pub speed: f32,
}

/// What a policy does, by condition.
#[derive(Serialize)]
#[serde(untagged)]
pub enum PolicyEvaluation {
    /// Following of velocity commands.
    Walking(Vec<Row<Evaluation>>),
    /// Walking on a course, by kind of ground.
    Course(Vec<KindOfGround>),
    /// Following of paths.
    Tracking(Vec<Row<ByPath>>),
    /// Landings.
    Jumping(Vec<Row<ByTarget>>),
    /// Following of gaits.
    Gaits(Vec<Row<ByGait>>),
    /// Following of an attitude.
    Attitudes(Vec<Row<AttitudeErrors>>),
    /// Getting up.
    GettingUp(Vec<Row<GettingUpTimes>>),
}

impl PolicyEvaluation {
    /// Returns a table.
    pub fn table(&self, options: &EvaluatePolicyOptions) -> String {
        let EvaluatePolicyOptions { robots, seconds, .. } = *options;
        match self {
            Self::Walking(rows) => {
                let table = measure_tables::walking(robots, seconds, rows);
                format!("{table}\n{}", measure_tables::by_speed(&rows[0].found))
            }
            Self::Course(kinds) => measure_tables::course(kinds),
            Self::Tracking(rows) => measure_tables::tracking(robots, seconds, rows),
            Self::Jumping(rows) => measure_tables::jumps(robots, rows),
            Self::Gaits(rows) => measure_tables::gaits(robots, seconds, rows),
            Self::Attitudes(rows) => measure_tables::attitude(robots, seconds, rows),
            Self::GettingUp(rows) => measure_tables::getup(robots, rows),
        }
    }
}

impl EvaluatePolicyOptions {
    /// Returns the options of 256 robots for 20 s under all conditions.
    pub fn new(policy: impl Into<PathBuf>) -> Self {
        Self {
            policy: policy.into(),
            model: None,
            engine: None,
            conditions: Vec::new(),
            course: None,
            robots: 256,
            seconds: 20.0,
            seed: 1_000_000,
            film: None,
        }
    }

    /// Returns the gains, pose and action scale of the policy, unless a model file states them.
    fn contract(&self) -> Option<ControlTable> {
        if self.model.is_some() { None } else { read_contract(&self.policy).ok() }
    }

    /// Returns the conditions that are wanted.
    fn wanted(&self) -> Vec<Condition> {
        let is_wanted = |condition: &Condition| self.conditions.iter().any(|name| name == condition.name);
        conditions(self.engine).into_iter().filter(|one| self.conditions.is_empty() || is_wanted(one)).collect()
    }
}

/// Measures what a policy does on fresh robots under each condition.
///
/// ```no_run
/// use twinstep_workflows::{EvaluatePolicyOptions, Observer, evaluate_policy};
///
/// let options = EvaluatePolicyOptions::new("data/policies/walk.safetensors");
/// print!("{}", evaluate_policy(&options, &Observer::silent())?.table(&options));
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn evaluate_policy(options: &EvaluatePolicyOptions, observer: &Observer) -> Result<PolicyEvaluation, Failure> {
    let seconds = options.seconds;
    if !(1.0..=3600.0).contains(&seconds) {
        return Err(Failure::Input(miette::miette!("`--seconds` = {seconds} is not allowed: 1 to 3600 s")));
    }
    let (policy, header) = Policy::read(&options.policy).map_err(input)?;
    let task = task_of(&policy, &header.origin.config);
    if let Some(path) = &options.film {
        let mut env = env(&options.wanted()[0], options, task.clone(), 1)?;
        check_spec(&policy, env.spec()).map_err(input)?;
        let film = film(&policy, env.as_mut(), options.seed).map_err(input)?;
        twinstep_files::write(path, film).map_err(|cause| {
            Failure::Input(miette::miette!("`--film` = {}: cannot write the file: {cause}", path.display()))
        })?;
    }
    let who = (options, &policy, observer);
    Ok(match &task {
        TaskConfig::Walk(trained) if let Some(on) = options.course => {
            PolicyEvaluation::Course(course(who, on, trained)?)
        }
        other if options.course.is_some() => {
            return Err(Failure::Input(miette::miette!(
                "`--course` is for policies of `walk`, and this is one of `{}`",
                other.name()
            )));
        }
        TaskConfig::Track(_) => PolicyEvaluation::Tracking(tracking(who)?),
        TaskConfig::Jump(trained) => PolicyEvaluation::Jumping(jumping(who, trained)?),
        TaskConfig::Gait(_) => PolicyEvaluation::Gaits(gaits(who)?),
        TaskConfig::Attitude(_) => PolicyEvaluation::Attitudes(attitudes(who)?),
        TaskConfig::Getup(_) => PolicyEvaluation::GettingUp(getting_up(who)?),
        task => PolicyEvaluation::Walking(walking(who, task)?),
    })
}

/// Creates `robots` robots under a condition.
fn env(
    condition: &Condition,
    options: &EvaluatePolicyOptions,
    task: TaskConfig,
    robots: usize,
) -> Result<Box<dyn VecEnv>, Failure> {
    let sim = SimConfig { engine: condition.engine, terrain: condition.terrain, ..SimConfig::default() };
    let (model, randomise, control) = (options.model.clone(), condition.randomise, options.contract());
    let config = TrainConfig { model, task, sim, randomise, control, ..TrainConfig::default() };
    Ok(config.envs(robots, 1, 0)?.remove(0))
}

/// Returns the task of a policy: that of `jump` with the targets of its training, and the others with default settings, but for
/// what they observe.
pub(crate) fn task_of(policy: &Policy, trained_with: &str) -> TaskConfig {
    let trained = TrainConfig::parse(trained_with, "the policy's config").map(|config| config.task);
    match (policy.spec.task.as_str(), trained) {
        ("jump", Ok(task @ TaskConfig::Jump(_))) => task,
        _ => TaskConfig::of_policy(&policy.spec).unwrap_or_default(),
    }
}

/// Measures what the policy does in several tasks under each condition. `measure` is that of a task on an environment.
fn measured<T, M: Measure>(
    (options, policy, observer): Who,
    conditions: &[Condition],
    tasks: &dyn Fn(&Condition) -> Vec<(TaskConfig, T)>,
    run: Run,
    new: impl Fn(&EnvSpec, usize, &T) -> Result<M, MeasureError>,
) -> Result<Vec<Row<Vec<M::Found>>>, Failure> {
    let mut rows = Vec::new();
    for condition in conditions {
        let bar = observer.bar(100, "{msg:10} {bar:32} {pos} %  ETA {eta}").with_message(condition.name);
        let tasks = tasks(condition);
        let mut found = Vec::new();
        for (index, (config, task)) in tasks.iter().enumerate() {
            let mut env = env(condition, options, config.clone(), options.robots as usize)?;
            let new = new(env.spec(), env.num_envs(), task).map_err(input)?;
            let proceed = |share: f64| show(&bar, (index as f64 + share) / tasks.len() as f64, observer);
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

type Who<'a> = (&'a EvaluatePolicyOptions, &'a Policy, &'a Observer);

fn run_of(options: &EvaluatePolicyOptions) -> Run {
    Run { seconds: options.seconds, seed: options.seed }
}

/// Evaluates the policy by velocity commands under each condition.
fn walking(who: Who, task: &TaskConfig) -> Result<Vec<Row<Evaluation>>, Failure> {
    let options = who.0;
    let robot = TrainConfig { model: options.model.clone(), control: options.contract(), ..TrainConfig::default() };
    let robot = robot.robots(1)?.control();
    let ControlledRobot { feet, torque_limits, .. } = &robot;
    let tasks = |_: &Condition| vec![(task.clone(), ())];
    let new = |spec: &EnvSpec, robots: usize, (): &()| Walking::new(spec, robots, feet, torque_limits);
    Ok(mapped(measured(who, &options.wanted(), &tasks, run_of(options), new)?, |mut found| found.remove(0)))
}

/// Evaluates the policy on a course.
fn course(who: Who, Course { terrain, speed }: Course, trained: &WalkConfig) -> Result<Vec<KindOfGround>, Failure> {
    let options = who.0;
    let robots = match options.conditions[..] {
        [] => Randomisation::default(),
        [_] => options.wanted()[0].randomise,
        _ => return Err(Failure::Input(miette::miette!("`--condition`: a course has the robots of one condition"))),
    };
    let condition = Condition {
        name: "course",
        engine: options.engine.unwrap_or(Engine::Batch),
        randomise: robots,
        terrain: Terrain::Course(terrain),
    };
    let tasks = |_: &Condition| vec![(TaskConfig::Walk(CourseWalking::task(trained, speed)), ())];
    let new = |_: &EnvSpec, robots: usize, (): &()| Ok(CourseWalking::new(terrain, robots));
    let run = Run { seconds: CourseWalking::SECONDS, ..run_of(options) };
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
    Ok(mapped(measured(who, &who.0.wanted(), &tasks, run_of(who.0), new)?, |paths| ByPath { paths }))
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
    Ok(mapped(measured(who, &who.0.wanted(), &tasks, run_of(who.0), new)?, |mut found| found.remove(0)))
}

/// Evaluates how fast the policy gets up under each condition.
fn getting_up(who: Who) -> Result<Vec<Row<GettingUpTimes>>, Failure> {
    let options = who.0;
    let robot = TrainConfig { model: options.model.clone(), ..TrainConfig::default() }.robots(1)?.control();
    let tasks = |_: &Condition| vec![(TaskConfig::Getup(GettingUp::task()), ())];
    let new = |spec: &EnvSpec, robots: usize, (): &()| {
        GettingUp::new(spec, robots, robot.standing_height.expect("a quadruped stands"))
    };
    let run = Run { seconds: GETUP_S, ..run_of(options) };
    Ok(mapped(measured(who, &options.wanted(), &tasks, run, new)?, |mut found| found.remove(0)))
}

/// Evaluates the landings of the policy under each condition.
fn jumping(who: Who, trained: &JumpConfig) -> Result<Vec<Row<ByTarget>>, Failure> {
    let options = who.0;
    let robot = TrainConfig { model: options.model.clone(), ..TrainConfig::default() }.quadruped()?;
    let mut wanted = options.wanted();
    // A jump is over before the first push.
    wanted.retain(|condition| condition.name != "pushes");
    let tasks = |_: &Condition| {
        let all = Jumping::tasks(trained).into_iter();
        all.map(|task| (TaskConfig::Jump(task.clone()), task)).collect()
    };
    let new = |spec: &EnvSpec, robots: usize, task: &JumpConfig| Ok(Jumping::new(spec, robots, &robot, task));
    let run = Run { seconds: JUMP_S, ..run_of(options) };
    Ok(mapped(measured(who, &wanted, &tasks, run, new)?, |targets| ByTarget { targets }))
}

/// Shows the share that is done. Returns false if the user has interrupted.
fn show(bar: &ProgressBar, share: f64, observer: &Observer) -> bool {
    bar.set_position((100.0 * share) as u64);
    matches!(observer.check(), Ok(false))
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
