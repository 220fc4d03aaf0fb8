//! U2E: collect, fit, train an exploration policy, collect, fit, …, in stages that can be resumed.

use std::path::{Path, PathBuf};

use crate::failure::{Failure, other};
use crate::fit::fit;
use crate::observer::Observer;
use crate::train::train;
use crate::train_options::TrainOptions;
use crate::u2e_config::{Method, Stop, U2eConfig, has_converged};
use crate::u2e_evaluation::{Collection, Evaluation};
use crate::{stages, u2e_report};

/// Learns the actuators of a robot by U2E with the settings of a config file, as far as it is not done. Returns the report.
///
/// ```no_run
/// use twinstep_workflows::{Observer, u2e};
///
/// print!("{}", u2e("examples/u2e.toml".as_ref(), &Observer::silent())?);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn u2e(config: &Path, observer: &Observer) -> Result<String, Failure> {
    let settings = U2eConfig::load(config, observer)?;
    let out = stages::folder_of(config)?;
    stages::keep_inputs(&out, settings.inputs()?)?;
    stages::ended(iterations(&settings, &out, observer), observer)
}

fn iterations(config: &U2eConfig, out: &Path, observer: &Observer) -> Result<String, Failure> {
    let mut stages: Vec<Stage> = Vec::new();
    let mut evaluations: Vec<Evaluation> = Vec::new();
    let mut report = String::new();
    for iteration in 0..=config.iterations {
        let stage = Stage::new(config, out, iteration)?;
        observer.note(format_args!("\n{}: policy, log, ensemble", stage.folder.display()));
        let policy = stage.policy(config, stages.last(), observer)?;
        stage.commands(config, observer)?;
        let collection = stage.collect(config, &policy, observer)?;
        stages.push(stage);
        evaluations.push(fit_and_evaluate(config, &stages, collection, observer)?);
        let uncertainties: Vec<f64> = evaluations.iter().filter_map(|evaluation| evaluation.uncertainty).collect();
        let ends = config.stop == Stop::Uncertainty && has_converged(&uncertainties, config.threshold);
        let robot = config.simulated_robot(Path::new(&stages[iteration].name).join("ensemble.safetensors"))?;
        stages::write(&out.join("robot.toml"), robot.as_bytes())?;
        report = u2e_report::write(config, out, &evaluations, ends)?;
        if ends {
            break;
        }
    }
    Ok(report)
}

/// Fits the ensemble of the last stage to all logs and evaluates it, unless both are complete.
fn fit_and_evaluate(
    config: &U2eConfig,
    stages: &[Stage],
    collection: Collection,
    observer: &Observer,
) -> Result<Evaluation, Failure> {
    let (stage, earlier) = stages.split_last().expect("a stage was added");
    let path = stage.folder.join("evaluation.json");
    if path.exists() && stage.ensemble().exists() {
        return stages::read_json(&path);
    }
    let logs: Vec<PathBuf> = stages.iter().map(Stage::log).collect();
    if !stage.ensemble().exists() {
        let partial = stage.folder.join("ensemble.partial.safetensors");
        let fitted = fit(&config.fitting(logs.clone(), earlier.last().map(Stage::ensemble), &partial), observer)?;
        observer.note(fitted.table());
        stages::complete(&partial, &stage.ensemble())?;
    }
    let ensembles: Vec<PathBuf> = stages.iter().map(Stage::ensemble).collect();
    let evaluation = Evaluation::new(&stage.name, collection, &ensembles, &logs, config.held_out.as_deref(), observer)?;
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
    fn policy(&self, config: &U2eConfig, earlier: Option<&Self>, observer: &Observer) -> Result<PathBuf, Failure> {
        let (Some(earlier), Method::Explore) = (earlier, config.method) else { return Ok(config.policy.clone()) };
        let policy = self.folder.join("policy.safetensors");
        if policy.exists() {
            return Ok(policy);
        }
        let model = self.folder.join("simulation.toml");
        let ensemble = Path::new("..").join(&earlier.name).join("ensemble.safetensors");
        stages::write(&model, config.simulated_robot(ensemble)?.as_bytes())?;
        let training = self.folder.join("training");
        let seed = config.seed + self.iteration as u64;
        let options = TrainOptions::new_or_resumed(
            training.clone(),
            config.training(model.canonicalize().unwrap_or(model)),
            seed,
        );
        train(&options, observer)?.complete()?;
        let partial = self.folder.join("policy.partial.safetensors");
        std::fs::copy(training.join("exploration.safetensors"), &partial).map_err(other)?;
        stages::complete(&partial, &policy)?;
        Ok(policy)
    }

    /// Writes the velocity commands, unless they are there.
    fn commands(&self, config: &U2eConfig, observer: &Observer) -> Result<(), Failure> {
        let (path, partial) = (self.folder.join("commands.csv"), self.folder.join("commands.partial.csv"));
        if path.exists() {
            return Ok(());
        }
        config.commands(self.iteration).write(&partial, observer)?;
        stages::complete(&partial, &path)
    }

    /// Records the log, unless it is there. An incomplete log is never kept.
    fn collect(&self, config: &U2eConfig, policy: &Path, observer: &Observer) -> Result<Collection, Failure> {
        let (log, summary) = (self.log(), self.folder.join("run.json"));
        let commands = self.folder.join("commands.csv");
        let recording = |partial: &Path| config.recording(policy, &commands, partial, self.iteration);
        stages::recorded((&log, &summary), config.seconds, recording, observer, |run, log| {
            Collection::new(run, log, observer)
        })
    }
}
