//! `twinstep u2e`: collect, fit, train an exploration policy, collect, fit, …, as one resumable command.

use std::path::{Path, PathBuf};

use crate::exit::{CommandResult, Failure, Signals, other};
use crate::u2e_config::{Method, Stop, U2eConfig, has_converged};
use crate::u2e_evaluation::{Collection, Evaluation};
use crate::{fit, stages, train, u2e_report};

/// Learn the actuators of a robot with uncertainty-guided exploration (U2E).
///
/// The base policy walks the robot at the endpoint, simulated or real. An ensemble of actuator networks is fitted to the
/// log. An exploration policy is then trained in the simulator that the ensemble drives, for motion on which its members
/// disagree; it walks the robot, the ensemble is refitted to all logs from its present weights, and so on. The folder of
/// CONFIG, without its extension, receives:
///
///   0-base                the log of the base policy, the ensemble, and what it predicts (evaluation.json)
///   1-explore, 2-explore  the training, the exploration policy, its log, and the ensemble of all logs so far
///   robot.toml            the robot with the newest ensemble, for `twinstep train --model` and `twinstep serve --model`
///   report.md             uncertainty, torque errors, robot time and falls; also progress.html, which grows
///
/// It ends after `iterations` logs of exploration, or earlier, by the rule of U2E: when the uncertainty of a new log, by
/// the ensemble before it, is less than `threshold` below that of the log before, relatively.
///
/// The same command continues after Ctrl-C, a crash or a power failure: what a stage has completed is kept, a training
/// continues at its checkpoint, and a log that was interrupted is recorded again. The robot walks without a question as
/// soon as a stage needs a log, `room_m` around where it then stands.
///
/// CONFIG (TOML); `policy` is required, the others have these defaults:
///
///   policy = "data/policies/walk.safetensors"   base policy, of the task `walk`
///   endpoint = "tcp/127.0.0.1:7447"
///   method = "explore"        or "random": base policy with noise on its actions; "base": base policy alone
///   iterations = 3            largest number of logs after the first one
///   stop = "uncertainty"      or "never": all iterations
///   threshold = 0.1           relative decrease of the uncertainty below which the iterations end
///   seconds = 60.0            duration of each log
///   segment_s = 5.0           duration of a velocity command, which is random
///   room_m = 3.0              largest distance from the start
///   action_noise = 0.2        of method "random": standard deviation in units of `action_scale`
///   draw = "episode"          or "step" (U2E): when a simulated robot draws another member of the ensemble
///   fast = false              step a simulated robot as fast as it answers
///   seed = 1
///   robot, zenoh              as of `twinstep run`; without a default
///   model                     model file with effects behind the torque sensor, such as friction and payload
///   held_out                  log that no ensemble learns from: the ensembles are compared on it
///   [fit]                     members = 6, hidden = 32, joint_input = "pooled", epochs = 100, smooth_hz
///   [explore]                 max_residual = 0.5, uncertainty_weight = 10.0, task_weight = 0.5, and [explore.walk]
///   [randomise]               as of `twinstep train`
///   [train]                   as of `twinstep train`; total_steps = 2000000
///
/// Example: `twinstep serve --envs 1 --engine mujoco --model hidden.toml` and, in another terminal,
/// `twinstep u2e examples/u2e.toml`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::doc_link_with_quotes, reason = "it is TOML")]
pub struct Args {
    /// Config file (TOML).
    config: PathBuf,
}

/// Runs the stages that are not complete.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    let config = U2eConfig::load(&args.config)?;
    let out = stages::folder_of(&args.config)?;
    stages::keep_inputs(&out, config.inputs()?)?;
    stages::ended(iterations(&config, &out, &signals))
}

fn iterations(config: &U2eConfig, out: &Path, signals: &Signals) -> CommandResult {
    let mut stages: Vec<Stage> = Vec::new();
    let mut evaluations: Vec<Evaluation> = Vec::new();
    for iteration in 0..=config.iterations {
        let stage = Stage::new(config, out, iteration)?;
        eprintln!("\n{}: policy, log, ensemble", stage.folder.display());
        let policy = stage.policy(config, stages.last(), signals)?;
        stage.commands(config, signals)?;
        let collection = stage.collect(config, &policy, signals)?;
        stages.push(stage);
        evaluations.push(fit_and_evaluate(config, &stages, collection, signals)?);
        let uncertainties: Vec<f64> = evaluations.iter().filter_map(|evaluation| evaluation.uncertainty).collect();
        let ends = config.stop == Stop::Uncertainty && has_converged(&uncertainties, config.threshold);
        let robot = config.simulated_robot(Path::new(&stages[iteration].name).join("ensemble.safetensors"))?;
        stages::write(&out.join("robot.toml"), robot.as_bytes())?;
        let report = u2e_report::write(config, out, &evaluations, ends)?;
        if ends || iteration == config.iterations {
            print!("{report}");
        }
        if ends {
            break;
        }
    }
    println!("\nwritten to {}", out.join("report.md").display());
    Ok(())
}

/// Fits the ensemble of the last stage to all logs and evaluates it, unless both are complete.
fn fit_and_evaluate(
    config: &U2eConfig,
    stages: &[Stage],
    collection: Collection,
    signals: &Signals,
) -> Result<Evaluation, Failure> {
    let (stage, earlier) = stages.split_last().expect("a stage was added");
    let path = stage.folder.join("evaluation.json");
    if path.exists() && stage.ensemble().exists() {
        return stages::read_json(&path);
    }
    let logs: Vec<PathBuf> = stages.iter().map(Stage::log).collect();
    if !stage.ensemble().exists() {
        let partial = stage.folder.join("ensemble.partial.safetensors");
        fit::write_ensemble(&config.fitting(logs.clone(), earlier.last().map(Stage::ensemble), &partial), signals)?;
        stages::complete(&partial, &stage.ensemble())?;
    }
    let ensembles: Vec<PathBuf> = stages.iter().map(Stage::ensemble).collect();
    let evaluation = Evaluation::new(&stage.name, collection, &ensembles, &logs, config.held_out.as_deref())?;
    stages::write_json(&path, &evaluation)?;
    Ok(evaluation)
}

/// An iteration and its files. A file exists only when it is complete.
struct Stage {
    iteration: usize,
    name: String,
    folder: PathBuf,
}

impl Stage {
    fn new(config: &U2eConfig, out: &Path, iteration: usize) -> Result<Self, Failure> {
        let kind = match config.method {
            _ if iteration == 0 => "base",
            Method::Explore => "explore",
            Method::Random => "random",
            Method::Base => "base",
        };
        let name = format!("{iteration}-{kind}");
        let folder = out.join(&name);
        stages::create_folder(&folder)?;
        Ok(Self { iteration, name, folder })
    }

    fn log(&self) -> PathBuf {
        self.folder.join("log")
    }

    fn ensemble(&self) -> PathBuf {
        self.folder.join("ensemble.safetensors")
    }

    /// Returns the policy that collects the log. Trains it in the simulator of the `earlier` stage's ensemble, unless it is
    /// the base policy or complete.
    fn policy(&self, config: &U2eConfig, earlier: Option<&Self>, signals: &Signals) -> Result<PathBuf, Failure> {
        let (Some(earlier), Method::Explore) = (earlier, config.method) else { return Ok(config.policy.clone()) };
        let policy = self.folder.join("policy.safetensors");
        if policy.exists() {
            return Ok(policy);
        }
        let (model, settings) = (self.folder.join("simulation.toml"), self.folder.join("training.toml"));
        let ensemble = Path::new("..").join(&earlier.name).join("ensemble.safetensors");
        stages::write(&model, config.simulated_robot(ensemble)?.as_bytes())?;
        stages::write(&settings, config.training(model).as_bytes())?;
        let training = self.folder.join("training");
        train::write_policy(&config.exploration(&settings, &training, self.iteration), signals)?;
        let partial = self.folder.join("policy.partial.safetensors");
        std::fs::copy(training.join("exploration.safetensors"), &partial).map_err(other)?;
        stages::complete(&partial, &policy)?;
        Ok(policy)
    }

    /// Writes the velocity commands, unless they are there.
    fn commands(&self, config: &U2eConfig, signals: &Signals) -> CommandResult {
        let (path, partial) = (self.folder.join("commands.csv"), self.folder.join("commands.partial.csv"));
        if path.exists() {
            return Ok(());
        }
        config.commands(self.iteration).write(&partial, signals)?;
        stages::complete(&partial, &path)
    }

    /// Records the log, unless it is there. An incomplete log is never kept.
    fn collect(&self, config: &U2eConfig, policy: &Path, signals: &Signals) -> Result<Collection, Failure> {
        let (log, summary) = (self.log(), self.folder.join("run.json"));
        let commands = self.folder.join("commands.csv");
        let recording = |partial: &Path| config.recording(policy, &commands, partial, self.iteration);
        stages::recorded((&log, &summary), config.seconds, recording, signals, Collection::new)
    }
}
