//! Settings of a training, and where it begins.

use std::path::{Path, PathBuf};

use twinstep_envs::TaskConfig;
use twinstep_learning::Checkpoint;

use crate::failure::{Failure, input};
use crate::train_config::TrainConfig;
use crate::web_page::PageOptions;

/// Files of a training, in its folder.
pub(crate) const POLICY: &str = "policy.safetensors";
pub(crate) const CHECKPOINT: &str = "checkpoint.safetensors";
/// The checkpoint before the last one.
pub(crate) const PREVIOUS: &str = "checkpoint.previous.safetensors";

/// Settings of [`train`](crate::train()).
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// Folder to write: policy, checkpoint, settings, progress and learning curve.
    pub out: PathBuf,
    /// Where the training begins.
    pub start: Start,
    /// Time after which it ends even if steps are left [min].
    pub minutes: Option<f64>,
    /// Zenoh endpoints of servers whose robots are trained on. Empty: robots of this process.
    pub endpoints: Vec<String>,
    /// Browser page of the robots.
    pub page: Option<PageOptions>,
}

/// Where a training begins.
#[derive(Clone, Debug)]
pub enum Start {
    /// With new networks.
    New {
        /// Task, robots and settings of the learner.
        config: Box<TrainConfig>,
        /// Seed of networks, robots, commands and exploration.
        seed: u64,
        /// Networks to start with: a checkpoint, or the actor of a policy with an untrained critic.
        from: Option<PathBuf>,
    },
    /// With the checkpoint in the folder.
    Resume {
        /// Total number of environment steps, if it is another one than before.
        total_steps: Option<u64>,
    },
}

/// Where a training has begun.
pub(crate) struct Started {
    pub config: TrainConfig,
    /// The settings as TOML.
    pub text: String,
    pub seed: u64,
    pub from: Option<PathBuf>,
    pub checkpoint: Option<Checkpoint>,
}

pub(crate) fn folder_error(folder: &Path, cause: std::io::Error) -> Failure {
    Failure::Input(miette::miette!("`--out` = {}: cannot write the folder: {cause}", folder.display()))
}

impl TrainOptions {
    /// Returns the options of a new training in the folder `out`.
    pub fn new(out: impl Into<PathBuf>, config: TrainConfig, seed: u64) -> Self {
        let start = Start::New { config: Box::new(config), seed, from: None };
        Self { out: out.into(), start, minutes: None, endpoints: Vec::new(), page: None }
    }

    /// Returns the options of a new training, or of its continuation if it was interrupted.
    pub fn new_or_resumed(out: PathBuf, config: TrainConfig, seed: u64) -> Self {
        let options = Self::new(out, config, seed);
        if options.checkpoint().exists() {
            Self { start: Start::Resume { total_steps: None }, ..options }
        } else {
            options
        }
    }

    /// Starts a new training with the networks of a checkpoint, or with the actor of a policy: fine-tuning.
    #[must_use]
    pub fn from(mut self, path: &Path) -> Self {
        if let Start::New { from, .. } = &mut self.start {
            *from = Some(path.to_owned());
        }
        self
    }

    /// Returns the path of the policy that the training writes.
    pub fn policy(&self) -> PathBuf {
        self.out.join(POLICY)
    }

    /// Removes the checkpoint of an earlier training, if any.
    pub fn remove_checkpoint(&self) -> std::io::Result<()> {
        match std::fs::remove_file(self.checkpoint()) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    fn checkpoint(&self) -> PathBuf {
        self.out.join(CHECKPOINT)
    }

    /// Checks the options, and that no earlier training would be overwritten.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        if let Some(minutes) = self.minutes.filter(|minutes| minutes.is_nan() || *minutes <= 0.0) {
            return Err(Failure::Input(miette::miette!("`--minutes` = {minutes} is not allowed: it must be positive")));
        }
        if matches!(self.start, Start::New { .. }) && self.checkpoint().exists() {
            let folder = self.out.display();
            return Err(Failure::Input(miette::miette!(
                "`--out` = {folder}: the folder has a training\n  continue it with --resume, or name another folder"
            )));
        }
        Ok(())
    }

    /// Returns where the training begins.
    pub(crate) fn started(&self) -> Result<Started, Failure> {
        let (config, seed, from, checkpoint) = match &self.start {
            Start::New { config, seed, from } => {
                if config.task == TaskConfig::Counter {
                    return Err(Failure::Input(miette::miette!(
                        "`task.name` = \"counter\" has nothing to learn: use \"walk\""
                    )));
                }
                config.train.check().map_err(input)?;
                if self.endpoints.is_empty() {
                    config.check()?;
                }
                ((**config).clone(), *seed, from.clone(), None)
            }
            Start::Resume { total_steps } => {
                let checkpoint = self.read_checkpoint()?;
                let mut config = TrainConfig::parse(&checkpoint.config, "the checkpoint's config")?;
                config.train.total_steps = total_steps.unwrap_or(config.train.total_steps);
                (config, checkpoint.seed, None, Some(checkpoint))
            }
        };
        let text = toml::to_string(&config).expect("settings are plain data");
        Ok(Started { config, text, seed, from, checkpoint })
    }

    /// Reads the checkpoint of the training. The error of one that is damaged names the one before.
    fn read_checkpoint(&self) -> Result<Checkpoint, Failure> {
        let previous = self.out.join(PREVIOUS);
        Checkpoint::read(self.checkpoint()).map_err(|error| {
            let hint =
                || miette::miette!("{error}\n  the one before it is {}: rename it to continue", previous.display());
            if previous.exists() { Failure::Input(hint()) } else { input(error) }
        })
    }
}
