//! `twinstep train`: trains a policy by proximal policy optimisation.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_envs::TaskConfig;
use twinstep_learning::{Checkpoint, Learner, LearningError, PpoConfig, Trainer};
use twinstep_measures::MeasureError;
use twinstep_model::EnvSpec;
use twinstep_policy::{Collector, CurvePoint, Mlp, Policy, PolicyOrigin, StepCollector, with_residual};
use twinstep_viewer::LearningPoint;

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::train_config::{TrainConfig, scene_info};
use crate::train_endpoints::remote_collectors;
use crate::train_evaluation;
use crate::train_log::{TrainLog, curve_point, write_curve};
use crate::web_view::{Page, ViewArgs};

/// The checkpoint before the last one.
const PREVIOUS: &str = "checkpoint.previous.safetensors";
/// Settings of a training on rough ground, slopes and stairs.
const TERRAIN: &str = include_str!("../../../data/policies/walk_terrain.toml");
/// Interval at which a running training is saved.
const SAVE_EVERY: Duration = Duration::from_secs(10);

/// Train a policy by proximal policy optimisation.
///
/// Simulates the robots on all cores, or runs the policy on the robots of servers (--endpoint), and
/// learns from the trajectories. The folder then contains:
///
///   policy.safetensors     the policy, with the spec of its environment
///   policy.onnx            the same for other runtimes: input `obs` [batch, N], output `action`
///   evaluation.json        errors and falls of 256 fresh robots
///   config.toml            all settings; --config config.toml repeats the training
///   progress.csv           errors, falls, rewards and times of every update, also for TensorBoard
///   curve.svg              learning curve
///   checkpoint.safetensors state of the training, saved every 10 s; before it checkpoint.previous.*
///   exploration.*          task `explore`: base policy and residual as one policy of `walk`
///
/// Ctrl-C saves the training and ends it; --resume continues it. Equal seeds and settings give
/// equal policies.
///
/// Examples: `twinstep train walk --out walk --seed 1`, or on the robot that a diagnosis found:
/// `twinstep train walk --out walk --model diagnosis/extended.toml --randomise-effects`, or from an
/// earlier training: `twinstep train walk --out tuned --from walk/checkpoint.safetensors --model
/// extended.toml --steps 5000000`, or any robot: `twinstep train pose --out arm --model arm.toml
/// --steps 1000000`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of the command")]
pub struct Args {
    /// Task to learn. Default: that of the config file, else walk.
    #[arg(value_parser = ["walk", "track", "jump", "gait", "attitude", "explore", "pose"])]
    task: Option<String>,
    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Config file (TOML) with [task], [sim], [randomise] and [train]. Flags override its values.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Learn to walk over slopes, stairs, obstacles, waves and rough ground, with the settings of
    /// data/policies/walk_terrain.toml. The progress names the mean level that the robots have reached.
    #[arg(long, conflicts_with_all = ["config", "endpoint", "resume"])]
    terrain: bool,
    /// Model file of the robot, or the name of one in this program, such as spot (docs/robots.md). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Sample every parameter of the model file that has an interval, for every robot in every episode.
    #[arg(long)]
    randomise_effects: bool,
    /// Seed of networks, robots, commands and exploration.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Total number of environment steps. Default: 8 million.
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Time after which the training ends even if steps are left [min].
    #[arg(long, value_name = "MIN", allow_negative_numbers = true)]
    minutes: Option<f64>,
    /// Number of robots. Default: 1024.
    #[arg(long, value_name = "N")]
    envs: Option<usize>,
    /// Train on the robots of a server at this Zenoh endpoint, such as tcp/127.0.0.1:7447; repeat it to divide the
    /// robots among several servers. A server that is lost is left out until it is back. The settings [task], [sim] and
    /// [randomise] are then those of the servers. Default: simulate in this process.
    #[arg(long, value_name = "ENDPOINT", value_delimiter = ',', conflicts_with_all = ["model", "randomise_effects"])]
    endpoint: Vec<String>,
    /// Policy of `walk` to whose actions the task `explore` adds a residual. With --endpoint: that of the servers.
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,
    /// Start with the networks of this checkpoint.safetensors of another training, or with the actor of this
    /// policy.safetensors and an untrained critic: fine-tuning. Task and gains must be the same; robot, rewards and
    /// randomisation may differ.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Continue the training in the folder with its settings and seed.
    #[arg(long, conflicts_with_all = ["config", "model", "randomise_effects", "seed", "envs"])]
    resume: bool,
    #[command(flatten)]
    view: ViewArgs,
    /// Print the evaluation as JSON on stdout.
    #[arg(long)]
    json: bool,
}

/// Trains, then evaluates the policy.
pub fn run(args: &Args) -> CommandResult {
    let start = Instant::now();
    let signals = Signals::listen()?;
    train_policy(args, &signals, start)?.report(args, &signals, start)
}

/// Trains all steps, without an evaluation, and writes the policy. Fails with [`Failure::Interrupted`] if a signal ended it.
pub fn write_policy(args: &Args, signals: &Signals) -> CommandResult {
    let session = train_policy(args, signals, Instant::now())?;
    let is_complete = session.trainer.learner().env_steps >= session.config.train.total_steps;
    if is_complete { Ok(()) } else { Err(Failure::Interrupted) }
}

fn train_policy(args: &Args, signals: &Signals, start: Instant) -> Result<TrainSession, Failure> {
    args.check()?;
    let checkpoint = if args.resume { Some(read_checkpoint(args)?) } else { None };
    let mut config = match &checkpoint {
        Some(checkpoint) => TrainConfig::parse(&checkpoint.config, "the checkpoint's config")?,
        None => args.config()?,
    };
    config.train.total_steps = args.steps.unwrap_or(config.train.total_steps);
    std::fs::create_dir_all(&args.out).map_err(|cause| folder_error(&args.out, cause))?;
    let text = toml::to_string(&config).expect("settings are plain data");
    twinstep_files::write(args.out.join("config.toml"), &text).map_err(|cause| folder_error(&args.out, cause))?;
    let mut session = TrainSession::new(args, config, text, checkpoint)?;
    let ended = session.train(signals, start);
    let saved = session.save();
    if ended.is_ok() {
        saved?;
    } else if let Err(Failure::Other(report) | Failure::Input(report)) = saved {
        eprintln!("error: the checkpoint is not saved: {report}");
    }
    match ended {
        Ok(()) => Ok(session),
        Err(Failure::Interrupted) => {
            eprintln!("interrupted; continue with: twinstep train --out {} --resume", args.out.display());
            Err(Failure::Interrupted)
        }
        Err(failure) => {
            eprintln!("the policy before the failure is in {}", args.out.display());
            Err(failure)
        }
    }
}

/// Reads the checkpoint of a training. The error of one that is damaged names the one before.
fn read_checkpoint(args: &Args) -> Result<Checkpoint, Failure> {
    let previous = args.out.join(PREVIOUS);
    Checkpoint::read(args.checkpoint()).map_err(|error| {
        let hint = || miette::miette!("{error}\n  the one before it is {}: rename it to continue", previous.display());
        if previous.exists() { Failure::Input(hint()) } else { input(error) }
    })
}

fn folder_error(folder: &Path, cause: std::io::Error) -> Failure {
    Failure::Input(miette::miette!("`--out` = {}: cannot write the folder: {cause}", folder.display()))
}

impl Args {
    /// Returns the arguments of a training with default settings in the folder `out`.
    pub fn new(out: PathBuf, seed: u64, steps: u64, view: ViewArgs) -> Self {
        Self {
            view,
            task: Some("walk".to_owned()),
            out,
            config: None,
            terrain: false,
            model: None,
            randomise_effects: false,
            seed,
            steps: Some(steps),
            minutes: None,
            envs: None,
            endpoint: Vec::new(),
            base: None,
            from: None,
            resume: false,
            json: false,
        }
    }

    /// Returns the arguments of a training with the settings of a config file, or of its continuation if it was
    /// interrupted.
    pub fn with_config(out: PathBuf, config: PathBuf, seed: u64) -> Self {
        let args =
            Self { task: None, steps: None, config: Some(config), ..Self::new(out, seed, 0, ViewArgs::default()) };
        if args.checkpoint().exists() { Self { config: None, resume: true, ..args } } else { args }
    }

    /// Returns the path of the policy that the training writes.
    pub fn policy(&self) -> PathBuf {
        self.out.join("policy.safetensors")
    }

    /// Removes the checkpoint of an earlier training, if any.
    pub fn remove_checkpoint(&self) -> std::io::Result<()> {
        match std::fs::remove_file(self.checkpoint()) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    fn checkpoint(&self) -> PathBuf {
        self.out.join("checkpoint.safetensors")
    }

    /// Checks the arguments, and that no earlier training would be overwritten.
    fn check(&self) -> CommandResult {
        if let Some(minutes) = self.minutes.filter(|minutes| minutes.is_nan() || *minutes <= 0.0) {
            return Err(Failure::Input(miette::miette!("`--minutes` = {minutes} is not allowed: it must be positive")));
        }
        if !self.resume && self.checkpoint().exists() {
            let folder = self.out.display();
            return Err(Failure::Input(miette::miette!(
                "`--out` = {folder}: the folder has a training\n  continue it with --resume, or name another folder"
            )));
        }
        Ok(())
    }

    fn config(&self) -> Result<TrainConfig, Failure> {
        let mut config = match &self.config {
            Some(path) => TrainConfig::load(path)?,
            None if self.terrain => TrainConfig::parse(TERRAIN, "data/policies/walk_terrain.toml")?,
            None => TrainConfig::default(),
        };
        if let Some(task) = self.task.as_deref().filter(|task| *task != config.task.name()) {
            if self.terrain {
                return Err(Failure::Input(miette::miette!(
                    "`--terrain` is for the task `walk`, and `{task}` is named"
                )));
            }
            if config.task != TaskConfig::default() {
                let of_config = config.task.name();
                return Err(Failure::Input(miette::miette!(
                    "`{task}` is not the task of the config file, `{of_config}`\n  name the same task, or none"
                )));
            }
            config.task = TaskConfig::named(task).expect("the argument was checked");
        }
        match (&mut config.task, &self.base) {
            (TaskConfig::Explore(explore), base) => {
                let base = base.as_ref().unwrap_or(&explore.base);
                explore.base = base.canonicalize().unwrap_or_else(|_| base.clone());
            }
            (other, Some(_)) => {
                return Err(Failure::Input(miette::miette!(
                    "`--base` is for the task `explore`, and the task is `{}`",
                    other.name()
                )));
            }
            _ => {}
        }
        if config.task == TaskConfig::Counter {
            return Err(Failure::Input(miette::miette!(
                "`task.name` = \"counter\" has nothing to learn: use \"walk\""
            )));
        }
        // The folder may be used from another working directory.
        config.model = self.model.clone().or(config.model).map(|path| path.canonicalize().unwrap_or(path));
        if config.has_tree() && self.config.is_none() {
            config.sim.physics_hz = None;
        }
        config.randomise.effects |= self.randomise_effects;
        if let Some(envs) = self.envs {
            (config.train.num_envs, config.train.groups) = (envs, config.train.groups.min(envs.max(1)));
        }
        config.train.check().map_err(input)?;
        if self.endpoint.is_empty() {
            config.check()?;
        }
        Ok(config)
    }
}

/// A training that runs.
struct TrainSession {
    config: TrainConfig,
    text: String,
    seed: u64,
    out: PathBuf,
    policy: PathBuf,
    endpoints: Vec<String>,
    minutes: Option<f64>,
    trainer: Trainer,
    curve: Vec<CurvePoint>,
    /// Base policy of the task `explore`.
    base: Option<Policy>,
    log: TrainLog,
    /// Shows the robots of the first group.
    page: Option<Page>,
}

/// Serves a page of the robots, if there is to be one. The robots of the training stay untouched.
fn open_page(args: &Args, config: &TrainConfig) -> Result<Option<Page>, Failure> {
    if !args.view.is_wanted() {
        return Ok(None);
    }
    let mut example = config.envs(1, 1, 1)?.remove(0);
    let robots = config.robots(1)?;
    let title = format!("twinstep train {}", config.task.name());
    args.view.open(example.as_mut(), |scene| scene_info(&robots, title, scene))
}

/// Returns a point of the learning curve as a page shows it.
fn learning_point(point: &CurvePoint) -> LearningPoint {
    let CurvePoint { env_steps, reward, velocity_rms, falls_per_minute, .. } = *point;
    LearningPoint { env_steps, reward, falls_per_minute, velocity_error: velocity_rms }
}

impl TrainSession {
    fn new(args: &Args, config: TrainConfig, text: String, checkpoint: Option<Checkpoint>) -> Result<Self, Failure> {
        let mut page = None;
        let collectors = match &args.endpoint[..] {
            [] => {
                let mut envs = config.envs(config.train.num_envs, config.train.groups, 1)?;
                page = open_page(args, &config)?;
                if let Some(page) = &page {
                    let first = envs.remove(0);
                    envs.insert(0, page.watch(first));
                }
                envs.into_iter().map(|env| Box::new(StepCollector(env)) as Box<dyn Collector>).collect()
            }
            _ if args.view.is_wanted() => {
                return Err(Failure::Input(miette::miette!(
                    "`--view` shows robots of this process, and --endpoint has others\n  start the server with \
                     `twinstep serve --view`"
                )));
            }
            endpoints => {
                let collectors = remote_collectors(endpoints, &config.train)?;
                check_task(&collectors[0].spec().task, config.task.name())?;
                collectors
            }
        };
        let base = match &config.task {
            TaskConfig::Explore(explore) => Some(Policy::read(&explore.base).map_err(input)?.0),
            _ => None,
        };
        let seed = checkpoint.as_ref().map_or(args.seed, |checkpoint| checkpoint.seed);
        let resumed_at = checkpoint.as_ref().map(|checkpoint| checkpoint.learner.env_steps);
        let (learner, curve) = match (checkpoint, &args.from) {
            (Some(checkpoint), _) => (Some(checkpoint.learner), checkpoint.curve),
            (None, Some(path)) => {
                (Some(earlier_networks(path, collectors[0].spec(), &config.train, seed)?), Vec::new())
            }
            (None, None) => (None, Vec::new()),
        };
        if let Some(page) = &page {
            page.hub().add_learning(curve.iter().map(learning_point));
        }
        let trainer = Trainer::new(config.train.clone(), collectors, learner, seed).map_err(input)?;
        let log = TrainLog::open(&args.out, &trainer.spec().reward_terms, resumed_at)
            .map_err(|cause| folder_error(&args.out, cause))?;
        let (out, policy) = (args.out.clone(), args.policy());
        let (endpoints, minutes) = (args.endpoint.clone(), args.minutes);
        Ok(Self { config, text, seed, out, policy, endpoints, minutes, trainer, curve, base, log, page })
    }

    /// Trains until all steps are done, the time is over, or the user interrupts.
    fn train(&mut self, signals: &Signals, start: Instant) -> CommandResult {
        let total = self.config.train.total_steps;
        let earlier = self.curve.last().map_or(0.0, |point| point.seconds);
        let bar = ProgressBar::new(total).with_position(self.trainer.learner().env_steps).with_style(
            ProgressStyle::with_template("{bar:24} {human_pos}/{human_len} env-steps  {per_sec}  ETA {eta}  {msg}")
                .expect("the template is valid"),
        );
        let mut saved = Instant::now();
        while self.trainer.learner().env_steps < total {
            if signals.check()? || self.minutes.is_some_and(|minutes| start.elapsed().as_secs_f64() > 60.0 * minutes) {
                break;
            }
            let iteration = self.trainer.iterate().map_err(|error| match error {
                LearningError::Config(_) => input(error),
                _ => other(error),
            })?;
            let seconds = earlier + start.elapsed().as_secs_f64();
            let point = curve_point(&iteration, self.trainer.spec().policy_dt, seconds);
            // A full disk costs rows and checkpoints, not the training: there may be room again at its end.
            let logged = self.log.write(&iteration, &point);
            self.curve.push(point);
            if let Some(page) = &self.page {
                page.hub().add_learning([learning_point(&point)]);
            }
            bar.set_position(iteration.env_steps);
            bar.set_message(progress_text(&point));
            if saved.elapsed() > SAVE_EVERY {
                if let Err(Failure::Other(report) | Failure::Input(report)) = logged.map_err(other).and(self.save()) {
                    // `println` of the bar prints nothing without a terminal.
                    bar.suspend(|| eprintln!("not saved, the training goes on: {report}"));
                }
                saved = Instant::now();
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    /// Writes checkpoint, policy and learning curve.
    fn save(&self) -> CommandResult {
        let (learner, spec) = (self.trainer.learner(), self.trainer.spec());
        let checkpoint = Checkpoint {
            learner: learner.clone(),
            spec: spec.clone(),
            seed: self.seed,
            config: self.text.clone(),
            curve: self.curve.clone(),
        };
        let path = self.out.join("checkpoint.safetensors");
        twinstep_files::keep_previous(&path, &self.out.join(PREVIOUS)).map_err(other)?;
        checkpoint.write(path).map_err(other)?;
        let policy = learner.policy(spec);
        policy.write(&self.policy, self.origin()).map_err(other)?;
        policy.write_onnx(self.out.join("policy.onnx")).map_err(other)?;
        if let (TaskConfig::Explore(explore), Some(base)) = (&self.config.task, &self.base) {
            let whole = with_residual(base, &policy, explore.max_residual);
            whole.write(self.out.join("exploration.safetensors"), self.origin()).map_err(other)?;
            whole.write_onnx(self.out.join("exploration.onnx")).map_err(other)?;
        }
        write_curve(&self.curve, &self.out.join("curve.svg")).map_err(other)
    }

    fn origin(&self) -> PolicyOrigin {
        PolicyOrigin {
            command: std::iter::once("twinstep".to_owned())
                .chain(std::env::args().skip(1))
                .collect::<Vec<_>>()
                .join(" "),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: option_env!("TWINSTEP_REVISION").map(str::to_owned),
            seed: self.seed,
            config: self.text.clone(),
            env_steps: self.trainer.learner().env_steps,
            curve: thinned(&self.curve),
        }
    }

    fn report(self, args: &Args, signals: &Signals, start: Instant) -> CommandResult {
        let Self { config, endpoints, out, trainer, .. } = self;
        let policy = trainer.learner().policy(trainer.spec());
        let steps = trainer.learner().env_steps as f64 / 1e6;
        // Robots of servers that collected rollouts are free for the evaluation.
        drop(trainer);
        let (json, text) = train_evaluation::evaluate_policy(&policy, &config, &endpoints, signals)?;
        twinstep_files::write(out.join("evaluation.json"), &json).map_err(other)?;
        let seconds = start.elapsed().as_secs_f64();
        if args.json {
            println!("{json}");
        } else {
            println!("trained {steps:.1} million steps in {seconds:.1} s; policy and curves in {}", args.out.display());
            print!("{text}");
        }
        Ok(())
    }
}

/// Fails if the servers have another task than the one that is to be learned.
fn check_task(of_servers: &str, named: &str) -> CommandResult {
    if of_servers == named {
        return Ok(());
    }
    Err(Failure::Input(miette::miette!(
        "the servers have the task `{of_servers}`, and the task to learn is `{named}`\n  name that of the servers: twinstep \
         train {of_servers}"
    )))
}

/// Returns the networks of another training's checkpoint, or the actor of a policy, for environments of this spec.
fn earlier_networks(path: &Path, spec: &EnvSpec, config: &PpoConfig, seed: u64) -> Result<Learner, Failure> {
    let (learner, earlier) = match Policy::read(path) {
        Ok((policy, _)) if policy.spec.hash() == spec.hash() => {
            (Learner::from_policy(&policy, config, spec, seed), policy.spec)
        }
        Ok((policy, _)) => return Err(other_spec(&policy.spec, spec)),
        Err(_) => {
            let Checkpoint { learner, spec: earlier, .. } = Checkpoint::read(path).map_err(input)?;
            (learner, earlier)
        }
    };
    if earlier.hash() != spec.hash() {
        return Err(other_spec(&earlier, spec));
    }
    let hidden = |network: &Mlp| network.sizes()[1..network.sizes().len() - 1].to_vec();
    let (actor, critic) = (hidden(&learner.actor), hidden(&learner.critic));
    if (&actor, &critic) != (&config.actor_hidden, &config.critic_hidden) {
        return Err(Failure::Input(miette::miette!(
            "`--from` = {}: its networks have {actor:?} and {critic:?} hidden units, and the settings {:?} and {:?}\n  set \
             `train.actor_hidden` and `train.critic_hidden` to those of the file",
            path.display(),
            config.actor_hidden,
            config.critic_hidden
        )));
    }
    Ok(learner.fine_tuned(config))
}

fn other_spec(earlier: &EnvSpec, spec: &EnvSpec) -> Failure {
    input(MeasureError::OtherSpec { policy: earlier.hash(), env: spec.hash() })
}

fn progress_text(point: &CurvePoint) -> String {
    let error = |value: Option<f64>, unit: &str| value.map_or(String::new(), |value| format!("{value:.2} {unit}, "));
    format!(
        "{}errors {}{}falls/min {:.1}, reward {:.3}",
        point.mean_level.map_or(String::new(), |level| format!("level {level:.1}, ")),
        error(point.velocity_rms, "m/s"),
        error(point.yaw_rate_rms, "rad/s"),
        point.falls_per_minute,
        point.reward
    )
}

/// Returns at most some hundred points of a curve, with its last one.
fn thinned(curve: &[CurvePoint]) -> Vec<CurvePoint> {
    let step = curve.len().div_ceil(200).max(1);
    curve.iter().rev().step_by(step).rev().copied().collect()
}
