//! Config file of `twinstep train`, and the environments that it describes.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twinstep_env_server::{Config, ConfigFileError, EnvFactory, ServerConfig, SimEnvFactory};
use twinstep_envs::{Randomisation, TaskConfig};
use twinstep_learning::PpoConfig;
use twinstep_model::{AutoresetMode, RobotModel, VecEnv};
use twinstep_sim::SimConfig;

use crate::exit::{Failure, input};

/// Rate of the batch engine's physics while a policy learns [Hz]. Policies are evaluated at the default rate of 1000 Hz.
///
/// 400 Hz takes 0.6 times the time of 1000 Hz, and policies that learn with it walk as well (results/walking.md).
const TRAINING_PHYSICS_HZ: u32 = 400;

/// Config file of a training (TOML). Every key is optional.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Model file of the robot. Default: the ideal Go2.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<PathBuf>,
    /// The task and its rewards.
    pub task: TaskConfig,
    /// Simulation settings.
    pub sim: SimConfig,
    /// Domain randomisation.
    pub randomise: Randomisation,
    /// Settings of the learner.
    pub train: PpoConfig,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            model: None,
            task: TaskConfig::default(),
            sim: SimConfig { physics_hz: Some(TRAINING_PHYSICS_HZ), ..SimConfig::default() },
            randomise: Randomisation::default(),
            train: PpoConfig::default(),
        }
    }
}

impl TrainConfig {
    /// Reads a config file.
    pub fn load(path: &Path) -> Result<Self, Failure> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| input(ConfigFileError::Unreadable { path: path.to_owned(), source }))?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Parses the text of a config file. Errors refer to the file as `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, Failure> {
        toml::from_str(text)
            .map_err(|error| input(ConfigFileError::Malformed { name: name.to_owned(), message: error.to_string() }))
    }

    /// Checks robot, task, simulation and randomisation.
    pub fn check(&self) -> Result<(), Failure> {
        self.factory(1).map(drop)
    }

    /// Builds `groups` batches of environments, `num_envs` in total, that are stepped by `threads` threads each.
    pub fn envs(&self, num_envs: usize, groups: usize, threads: usize) -> Result<Vec<Box<dyn VecEnv>>, Failure> {
        let factory = self.factory(threads)?;
        (0..groups)
            .map(|group| {
                let robots = num_envs / groups + usize::from(group < num_envs % groups);
                factory.build(robots, AutoresetMode::SameStep, None).map_err(input)
            })
            .collect()
    }

    /// Returns the nominal robot, also that of a model file with actuator networks.
    pub fn robot(&self) -> Result<RobotModel, Failure> {
        Ok(self.factory(1)?.robot().clone())
    }

    fn factory(&self, threads: usize) -> Result<SimEnvFactory, Failure> {
        let config = Config {
            server: ServerConfig { model: self.model.clone(), ..ServerConfig::default() },
            task: self.task.clone(),
            sim: SimConfig { threads, ..self.sim },
            randomise: self.randomise,
        };
        config.check().map_err(input)?;
        SimEnvFactory::new(config).map_err(input)
    }
}
