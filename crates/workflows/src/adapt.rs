//! Adaptation of a policy to the robot of a log: cause, corrected model, fine-tuned policy, gain.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_diagnose::Diagnosis;
use twinstep_envs::Randomisation;
use twinstep_measures::{Run, check_spec};
use twinstep_model::{AutoresetMode, VecEnv};
use twinstep_policy::{Policy, PolicyOrigin};
use twinstep_sim::SimConfig;

use crate::checks::within;
use crate::comparison::Comparison;
use crate::diagnose::{DiagnoseOptions, diagnose};
use crate::evaluate_policy::task_of;
use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::stages;
use crate::task_error::{RobotError, TaskError};
use crate::train::train;
use crate::train_config::TrainConfig;
use crate::train_options::TrainOptions;

/// Seed of the robots on which the policies are compared. No training has it.
const COMPARED_SEED: u64 = 2_000_000;

/// Settings of [`adapt`].
#[derive(Clone, Debug)]
pub struct AdaptOptions {
    /// Policy file (safetensors) of `walk`, `gait`, `track`, `jump` or `attitude`.
    pub policy: PathBuf,
    /// Logs of the robot.
    pub logs: Vec<PathBuf>,
    /// Model file of the robot that the policy was trained on. `None`: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Zenoh endpoint of the robot. `None`: the gain is predicted, and not measured.
    pub endpoint: Option<String>,
    /// Environment steps of the fine-tuning.
    pub steps: u64,
    /// Number of simulated robots on which the policies are compared, in one run each.
    pub robots: usize,
    /// Number of runs of the robot at the endpoint with each policy.
    pub runs: usize,
    /// Duration of a run [s].
    pub seconds: f64,
    /// Seed of the fine-tuning and of the runs.
    pub seed: u64,
    /// Folder to write.
    pub out: PathBuf,
}

impl AdaptOptions {
    /// Returns the options of an adaptation by 12 million steps, and without a robot.
    pub fn new(policy: impl Into<PathBuf>, logs: Vec<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self {
            policy: policy.into(),
            logs,
            model: None,
            endpoint: None,
            steps: 12_000_000,
            robots: 24,
            runs: 2,
            seconds: 20.0,
            seed: 1,
            out: out.into(),
        }
    }
}

/// Result of [`adapt`]: `adapt.json` in its folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adapted {
    /// Causes of the difference between model and robot, with their scopes.
    pub causes: Vec<String>,
    /// What the error is.
    pub error: String,
    /// Its unit.
    pub unit: String,
    /// The policies on robots of the corrected model, whose parameters are drawn from their intervals.
    pub predicted: Comparison,
    /// The policies on the robot at the endpoint.
    pub found: Option<Comparison>,
    /// True if the new policy is kept, false if the old one is.
    pub is_adapted: bool,
}

/// Adapts a policy to the robot of a log: finds what the model lacks, fine-tunes the policy on the corrected model, predicts the
/// gain in its task and, if there is an endpoint, measures it.
///
/// `policy.safetensors` in the folder is the better one of the two policies. A repeated call continues an interrupted one.
///
/// ```no_run
/// use twinstep_workflows::{AdaptOptions, Observer, adapt};
///
/// let options = AdaptOptions::new("data/policies/walk.safetensors", vec!["log".into()], "adapted");
/// let adapted = adapt(&options, &Observer::silent())?;
/// println!("{:?}: {:.0} % less error", adapted.causes, 100.0 * adapted.predicted.reduction);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn adapt(options: &AdaptOptions, observer: &Observer) -> Result<Adapted, Failure> {
    options.check()?;
    let (policy, header) = Policy::read(&options.policy).map_err(input)?;
    let trained = trained_with(&policy, &header.origin, options.model.as_deref())?;
    let compared = Compared::new(options, &trained)?;
    // All of it before minutes of computing, not after them.
    check_spec(&policy, compared.config.envs(1, 1, 1)?[0].spec()).map_err(input)?;
    let inputs = options.inputs(observer)?;
    if let Some(endpoint) = &options.endpoint {
        compared.check_endpoint(endpoint, &policy, observer)?;
    }
    let before = std::fs::read(&options.policy).map_err(other)?;
    stages::keep_inputs(&options.out, vec![("settings.txt", inputs), ("policy.safetensors", before)])?;
    stages::ended(adapted(options, &policy, &trained, &compared, observer), observer)
}

fn adapted(
    options: &AdaptOptions,
    policy: &Policy,
    trained: &TrainConfig,
    compared: &Compared,
    observer: &Observer,
) -> Result<Adapted, Failure> {
    let (causes, model) = causes(options, observer)?;
    let tuned = fine_tuned(options, trained, &model, observer)?;
    let (new, _) = Policy::read(&tuned).map_err(input)?;
    let policies = [policy, &new];
    observer.note("\npredicted: both policies on robots of the corrected model");
    let predicted = compared.in_simulation(&model, policies, observer)?;
    let found = match &options.endpoint {
        Some(endpoint) => {
            observer.note(format_args!("\nfound: both policies on the robot at {endpoint}"));
            Some(compared.on_robot(endpoint, policies, observer)?)
        }
        None => None,
    };
    let is_adapted = found.as_ref().unwrap_or(&predicted).is_better();
    let kept = if is_adapted { &tuned } else { &options.policy };
    let content = std::fs::read(kept).map_err(other)?;
    stages::write(&options.out.join("policy.safetensors"), &content)?;
    let (error, unit) = (compared.error.name().to_owned(), compared.error.unit().to_owned());
    let adapted = Adapted { causes, error, unit, predicted, found, is_adapted };
    stages::write_json(&options.out.join("adapt.json"), &adapted)?;
    Ok(adapted)
}

/// Diagnoses the logs, unless that is done. Returns the names of the causes, and the corrected model.
fn causes(options: &AdaptOptions, observer: &Observer) -> Result<(Vec<String>, PathBuf), Failure> {
    let folder = options.out.join("diagnosis");
    let findings = folder.join("findings.json");
    let diagnosis: Diagnosis = if findings.exists() {
        stages::read_json(&findings)?
    } else {
        observer.note(format_args!("{}: causes, corrected model", folder.display()));
        let diagnosis =
            DiagnoseOptions { model: options.model.clone(), ..DiagnoseOptions::new(options.logs.clone(), &folder) };
        let found = diagnose(&diagnosis, observer)?;
        observer.note(&found.text);
        // Those of another model must not be mistaken for the results of this one.
        stages::discard(&options.out.join("training"))?;
        stages::discard(&options.out.join("tuned.safetensors"))?;
        found.diagnosis
    };
    if diagnosis.extended_model.is_empty() {
        return Err(Failure::Input(miette::miette!(
            "the diagnosis has no corrected model\n  name the model of the robot with --model"
        )));
    }
    let name = |cause: &twinstep_diagnose::Cause| format!("{}@{}", cause.effect, cause.scope);
    Ok((diagnosis.findings.iter().map(name).collect(), folder.join("extended.toml")))
}

/// Fine-tunes the policy on the corrected model, unless that is done. Returns its file.
fn fine_tuned(
    options: &AdaptOptions,
    trained: &TrainConfig,
    model: &Path,
    observer: &Observer,
) -> Result<PathBuf, Failure> {
    let tuned = options.out.join("tuned.safetensors");
    if tuned.exists() {
        return Ok(tuned);
    }
    let folder = options.out.join("training");
    observer.note(format_args!("{}: fine-tuning on the corrected model", folder.display()));
    let mut config = TrainConfig { model: Some(absolute(model)), ..trained.clone() };
    config.randomise.effects = true;
    config.train.total_steps = options.steps;
    let training = TrainOptions::new_or_resumed(folder, config, options.seed).from(&options.policy);
    train(&training, observer)?.complete()?;
    let partial = options.out.join("tuned.partial.safetensors");
    std::fs::copy(training.policy(), &partial).map_err(other)?;
    stages::complete(&partial, &tuned)?;
    Ok(tuned)
}

/// Returns a path that is valid in every folder; the name of a robot of this program stays.
fn absolute(path: &Path) -> PathBuf {
    let file = path.canonicalize().ok().filter(|path| path.is_file());
    file.unwrap_or_else(|| path.to_owned())
}

/// Returns the settings with which a policy was trained, or the default ones of its task and networks, on the nominal model.
fn trained_with(policy: &Policy, origin: &PolicyOrigin, model: Option<&Path>) -> Result<TrainConfig, Failure> {
    let parsed = TrainConfig::parse(&origin.config, "the policy's config");
    let mut config =
        parsed.unwrap_or_else(|_| TrainConfig { task: task_of(policy, &origin.config), ..TrainConfig::default() });
    let sizes = policy.actor.sizes();
    config.train.actor_hidden = sizes[1..sizes.len() - 1].to_vec();
    config.model = model.map(absolute);
    config.check()?;
    Ok(config)
}

/// How the policies are compared.
struct Compared {
    error: TaskError,
    config: TrainConfig,
    robots: usize,
    runs: usize,
    run: Run,
}

impl Compared {
    fn new(options: &AdaptOptions, trained: &TrainConfig) -> Result<Self, Failure> {
        let (error, task) = TaskError::of(trained)?;
        let randomise = Randomisation { effects: true, ..Randomisation::default() };
        let config = TrainConfig { task, randomise, sim: SimConfig::default(), ..trained.clone() };
        let run = Run { seconds: options.seconds, seed: COMPARED_SEED + options.seed };
        Ok(Self { error, config, robots: options.robots, runs: options.runs, run })
    }

    /// Compares the policies on robots of a model, each with its own parameters within their intervals.
    fn in_simulation(&self, model: &Path, policies: [&Policy; 2], observer: &Observer) -> Result<Comparison, Failure> {
        let config = TrainConfig { model: Some(absolute(model)), ..self.config.clone() };
        let mut env = config.envs(1, 1, 1)?.remove(0);
        let bar = observer.bar(self.robots as u64, "{bar:32} {pos}/{len} robots  ETA {eta}");
        let mut pairs = Vec::new();
        for robot in 0..self.robots as u64 {
            pairs.push(self.pair(env.as_mut(), policies, robot, observer)?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        compared(&pairs)
    }

    /// Compares the policies on the robot at an endpoint, run by run.
    fn on_robot(&self, endpoint: &str, policies: [&Policy; 2], observer: &Observer) -> Result<Comparison, Failure> {
        let mut env = connect(endpoint, observer)?;
        let runs = (0..self.runs as u64).map(|run| self.pair(&mut env, policies, run, observer));
        let runs = runs.collect::<Result<Vec<_>, _>>();
        // What ended the runs matters, not what ends the connection.
        let _ = env.close();
        let runs = runs?;
        compared(&[[0, 1].map(|policy| mean(&runs.iter().map(|pair| pair[policy]).collect::<Vec<_>>()))])
    }

    /// Fails if the robot at an endpoint is not one of the policy, or does not observe what the error needs.
    fn check_endpoint(&self, endpoint: &str, policy: &Policy, observer: &Observer) -> Result<(), Failure> {
        self.error.check_task()?;
        let env = connect(endpoint, observer)?;
        let checked = check_spec(policy, env.spec()).map_err(input).and_then(|()| self.error.check(env.spec()));
        // Otherwise the robot is taken until the grace period has passed.
        let closed = env.close().map_err(other);
        checked.and(closed)
    }

    /// Returns the error of a robot under each policy, with the same commands.
    fn pair(
        &self,
        env: &mut dyn VecEnv,
        policies: [&Policy; 2],
        index: u64,
        observer: &Observer,
    ) -> Result<[RobotError; 2], Failure> {
        let run = Run { seed: self.run.seed + index, ..self.run };
        let [before, after] = policies.map(|policy| self.error.measure(policy, env, run, observer));
        Ok([before?, after?])
    }
}

fn compared(pairs: &[[RobotError; 2]]) -> Result<Comparison, Failure> {
    let too_short =
        || Failure::Other(miette::miette!("no robot stays up for a second under both policies: nothing to compare"));
    Comparison::new(pairs).ok_or_else(too_short)
}

fn connect(endpoint: &str, observer: &Observer) -> Result<RemoteVecEnv, Failure> {
    let options = ConnectOptions {
        interrupted: observer.flag(),
        autoreset: AutoresetMode::SameStep,
        max_episode_steps: Some(u32::MAX),
        critic: true,
        ..ConnectOptions::new(endpoint, 1)
    };
    RemoteVecEnv::connect(&options).map_err(|error| observer.check().err().unwrap_or_else(|| other(error)))
}

fn mean(runs: &[RobotError]) -> RobotError {
    let errors: Vec<f64> = runs.iter().filter_map(|run| run.error).collect();
    let error = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
    RobotError { error, has_fallen: runs.iter().any(|run| run.has_fallen) }
}

impl AdaptOptions {
    fn check(&self) -> Result<(), Failure> {
        let within = |name: &str, value, low, high| {
            within(&format!("--{name}"), value, low, high).map_err(|cause| Failure::Input(miette::miette!("{cause}")))
        };
        within("steps", self.steps as f64, 1.0, 1e12)?;
        within("robots", self.robots as f64, 1.0, 10_000.0)?;
        within("runs", self.runs as f64, 1.0, 1000.0)?;
        within("seconds", self.seconds, 2.0, 3600.0)
    }

    /// Returns what the stages that are kept depend on, beside the policy. Fails if a log cannot be used.
    fn inputs(&self, observer: &Observer) -> Result<Vec<u8>, Failure> {
        let mut text = format!("steps {}\nseed {}\n", self.steps, self.seed);
        for path in &self.logs {
            let log = open_log(path, observer)?;
            let cells = log.t().iter().chain(log.joints().iter().filter_map(|joint| log.q(joint)).flatten());
            let digest = cells.fold(Sha256::new(), |digest, cell| digest.chain_update(cell.to_le_bytes())).finalize();
            let _ = writeln!(text, "log {} {:02x?}", path.display(), &digest[..8]);
        }
        let model = self.model.as_deref().map(|path| std::fs::read_to_string(path).unwrap_or_default());
        let name = self.model.as_deref().map_or("the ideal go2".to_owned(), |path| path.display().to_string());
        let _ = writeln!(text, "model {name}\n{}", model.unwrap_or_default());
        Ok(text.into_bytes())
    }
}
