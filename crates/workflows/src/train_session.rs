//! A training that runs: its robots, networks, files and page.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use twinstep_envs::TaskConfig;
use twinstep_learning::{Checkpoint, Learner, LearningError, PpoConfig, Trainer};
use twinstep_measures::MeasureError;
use twinstep_model::EnvSpec;
use twinstep_policy::{Collector, CurvePoint, Mlp, Policy, PolicyOrigin, StepCollector, with_residual};
use twinstep_viewer::LearningPoint;

use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::train_config::{TrainConfig, scene_info};
use crate::train_endpoints::remote_collectors;
use crate::train_log::{TrainLog, curve_point, write_curve};
use crate::train_options::{CHECKPOINT, POLICY, PREVIOUS, Started, TrainOptions, folder_error};
use crate::web_page::{Page, PageOptions};

/// Interval at which a running training is saved.
const SAVE_EVERY: Duration = Duration::from_secs(10);

/// A training that runs.
pub struct TrainSession {
    config: TrainConfig,
    text: String,
    seed: u64,
    out: PathBuf,
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
fn open_page(page: Option<&PageOptions>, config: &TrainConfig) -> Result<Option<Page>, Failure> {
    let Some(page) = page else { return Ok(None) };
    let mut example = config.envs(1, 1, 1)?.remove(0);
    let robots = config.robots(1)?;
    let title = format!("twinstep train {}", config.task.name());
    page.open(example.as_mut(), |scene| scene_info(&robots, title, scene)).map(Some)
}

/// Returns a point of the learning curve as a page shows it.
fn learning_point(point: &CurvePoint) -> LearningPoint {
    let CurvePoint { env_steps, reward, velocity_rms, falls_per_minute, .. } = *point;
    LearningPoint { env_steps, reward, falls_per_minute, velocity_error: velocity_rms }
}

impl TrainSession {
    /// Prepares a training, which continues that of `checkpoint` if there is one.
    pub fn new(options: &TrainOptions, start: Started) -> Result<Self, Failure> {
        let Started { config, text, seed, from, checkpoint } = start;
        let mut page = None;
        let collectors = match &options.endpoints[..] {
            [] => {
                let mut envs = config.envs(config.train.num_envs, config.train.groups, 1)?;
                page = open_page(options.page.as_ref(), &config)?;
                if let Some(page) = &page {
                    let first = envs.remove(0);
                    envs.insert(0, page.watch(first));
                }
                envs.into_iter().map(|env| Box::new(StepCollector(env)) as Box<dyn Collector>).collect()
            }
            _ if options.page.is_some() => {
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
            TaskConfig::Explore(explore) if explore.base.as_os_str().is_empty() => {
                return Err(Failure::Input(miette::miette!(
                    "`--base` is missing: the trained residual is also written with its base policy, as one policy\n  \
                     pass the policy of the servers: --base FILE"
                )));
            }
            TaskConfig::Explore(explore) => Some(Policy::read(&explore.base).map_err(input)?.0),
            _ => None,
        };
        let resumed_at = checkpoint.as_ref().map(|checkpoint| checkpoint.learner.env_steps);
        let (learner, curve) = match (checkpoint, &from) {
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
        let out = options.out.clone();
        let log = TrainLog::open(&out, &trainer.spec().reward_terms, resumed_at)
            .map_err(|cause| folder_error(&out, cause))?;
        Ok(Self { config, text, seed, out, minutes: options.minutes, trainer, curve, base, log, page })
    }

    /// Trains until all steps are done, the time is over, or the user interrupts.
    pub fn train(&mut self, observer: &Observer, start: Instant) -> Result<(), Failure> {
        let total = self.config.train.total_steps;
        let earlier = self.curve.last().map_or(0.0, |point| point.seconds);
        let bar = observer
            .bar(total, "{bar:24} {human_pos}/{human_len} env-steps  {per_sec}  ETA {eta}  {msg}")
            .with_position(self.trainer.learner().env_steps);
        let mut saved = Instant::now();
        while self.trainer.learner().env_steps < total {
            if observer.check()? || self.minutes.is_some_and(|minutes| start.elapsed().as_secs_f64() > 60.0 * minutes) {
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
                    bar.suspend(|| observer.note(format_args!("not saved, the training goes on: {report}")));
                }
                saved = Instant::now();
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    /// Writes checkpoint, policy and learning curve.
    pub fn save(&self) -> Result<(), Failure> {
        let (learner, spec) = (self.trainer.learner(), self.trainer.spec());
        let checkpoint = Checkpoint {
            learner: learner.clone(),
            spec: spec.clone(),
            seed: self.seed,
            config: self.text.clone(),
            curve: self.curve.clone(),
        };
        let path = self.out.join(CHECKPOINT);
        twinstep_files::keep_previous(&path, &self.out.join(PREVIOUS)).map_err(other)?;
        checkpoint.write(path).map_err(other)?;
        let policy = learner.policy(spec);
        policy.write(self.out.join(POLICY), self.origin()).map_err(other)?;
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

    /// Returns the policy, the settings and the number of environment steps.
    pub fn ended(self) -> (Policy, TrainConfig, u64) {
        let learner = self.trainer.learner();
        (learner.policy(self.trainer.spec()), self.config, learner.env_steps)
    }
}

/// Fails if the servers have another task than the one that is to be learned.
fn check_task(of_servers: &str, named: &str) -> Result<(), Failure> {
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
