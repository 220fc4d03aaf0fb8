//! Settings of a training, and the environments that it describes.

use std::path::{Path, PathBuf};
use twinstep_effects::parse_toml;

use serde::{Deserialize, Serialize};
use twinstep_effects::ControlTable;
use twinstep_env_server::{
    AnyEnvFactory, Config, ConfigFileError, EnvFactory, ServerConfig, SimEnvFactory, is_of_tree,
};
use twinstep_envs::{Randomisation, TaskConfig};
use twinstep_learning::PpoConfig;
use twinstep_model::{AutoresetMode, RobotModel, Scene, VecEnv};
use twinstep_sim::{Engine, SimConfig};
use twinstep_viewer::SceneInfo;

use crate::failure::{Failure, input};

/// Rate of the batch engine's physics while a policy learns [Hz]. Policies are evaluated at the default rate of 1000 Hz.
///
/// 400 Hz takes 0.6 times the time of 1000 Hz, and policies that learn with it walk as well (results/walking.md).
const TRAINING_PHYSICS_HZ: u32 = 400;

/// Settings of a training on rough ground, slopes and stairs.
const TERRAIN: &str = include_str!("../../../data/policies/walk_terrain.toml");

/// Settings of a training to get up.
const GETUP: &str = include_str!("../../../data/policies/getup.toml");

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
    /// Gains, default pose and action scale in place of those of the model file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub control: Option<ControlTable>,
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
            control: None,
            train: PpoConfig::default(),
        }
    }
}

impl TrainConfig {
    /// Reads a config file. Without a physics rate, that of the batch engine is 400 Hz.
    pub fn load(path: &Path) -> Result<Self, Failure> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| input(ConfigFileError::Unreadable { path: path.to_owned(), source }))?;
        let mut config = Self::parse(&text, &path.display().to_string())?;
        // The rate was measured with quadrupeds; other robots have the engine's own.
        if config.sim.engine == Engine::Batch && !config.has_tree() {
            config.sim.physics_hz.get_or_insert(TRAINING_PHYSICS_HZ);
        }
        Ok(config)
    }

    /// Returns the settings of a walk on rough ground, slopes and stairs: those of `data/policies/walk_terrain.toml`.
    pub fn terrain() -> Self {
        parse_toml(TERRAIN).expect("settings of this program are valid")
    }

    /// Returns the settings of a task without a config file: those of `data/policies/getup.toml` for `getup`, and the defaults for the
    /// others. `None` if there is no such task.
    pub fn of_task(name: &str) -> Option<Self> {
        match name {
            "getup" => Some(parse_toml(GETUP).expect("settings of this program are valid")),
            _ => Some(Self { task: TaskConfig::named(name)?, ..Self::default() }),
        }
    }

    /// Returns true if the robots are simulated as a tree.
    pub fn has_tree(&self) -> bool {
        matches!(self.task, TaskConfig::Pose(_)) || self.model.as_deref().is_some_and(is_of_tree)
    }

    /// Parses the text of a config file. Errors refer to the file as `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, Failure> {
        parse_toml(text)
            .map_err(|error| input(ConfigFileError::Malformed { name: name.to_owned(), message: error.to_string() }))
    }

    /// Checks robot, task, simulation and randomisation.
    pub fn check(&self) -> Result<(), Failure> {
        self.robots(1).map(drop)
    }

    /// Builds `groups` batches of environments, `num_envs` in total, that are stepped by `threads` threads each.
    pub fn envs(&self, num_envs: usize, groups: usize, threads: usize) -> Result<Vec<Box<dyn VecEnv>>, Failure> {
        let factory = self.robots(threads)?;
        (0..groups)
            .map(|group| {
                let robots = num_envs / groups + usize::from(group < num_envs % groups);
                factory.build(robots, AutoresetMode::SameStep, None).map_err(input)
            })
            .collect()
    }

    /// Returns the nominal quadruped, also that of a model file with actuator networks.
    pub fn quadruped(&self) -> Result<RobotModel, Failure> {
        Ok(SimEnvFactory::new(self.of_server(1)?).map_err(input)?.robot().clone())
    }

    /// Returns the robots with this number of threads.
    pub fn robots(&self, threads: usize) -> Result<AnyEnvFactory, Failure> {
        AnyEnvFactory::new(self.of_server(threads)?).map_err(input)
    }

    fn of_server(&self, threads: usize) -> Result<Config, Failure> {
        let config = Config {
            server: ServerConfig { model: self.model.clone(), ..ServerConfig::default() },
            task: self.task.clone(),
            sim: SimConfig { threads, ..self.sim },
            randomise: self.randomise,
            control: self.control.clone(),
        };
        config.check().map_err(input)?;
        Ok(config)
    }
}

/// Describes a scene of a robot.
pub fn scene_info(robots: &AnyEnvFactory, title: impl Into<String>, scene: &Scene) -> SceneInfo {
    match robots {
        AnyEnvFactory::Quadruped(factory) => SceneInfo::new(title, scene, factory.robot()),
        AnyEnvFactory::Tree(factory) => SceneInfo::of_tree(title, scene, factory.tree()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_of_this_program_are_valid_and_those_of_a_task_are_for_it() {
        TrainConfig::terrain().train.check().expect("valid");
        for name in TaskConfig::NAMES {
            let config = TrainConfig::of_task(name).expect("a task");
            assert_eq!(config.task.name(), name);
            assert_eq!(config.sim.physics_hz, Some(TRAINING_PHYSICS_HZ), "{name}");
            config.train.check().expect("valid");
        }
        assert!(TrainConfig::of_task("fly").is_none());
    }

    #[test]
    fn one_key_of_the_simulation_leaves_the_physics_rate_of_a_training() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("train.toml");
        let physics_hz = |text: &str| {
            std::fs::write(&path, text).expect("written");
            TrainConfig::load(&path).expect("valid").sim.physics_hz
        };
        assert_eq!(physics_hz("[sim]\nterrain = { slope_rad = 0.1 }"), Some(TRAINING_PHYSICS_HZ));
        assert_eq!(physics_hz("[sim]\nphysics_hz = 800"), Some(800));
        assert_eq!(physics_hz("[sim]\nengine = \"rapier\""), None, "the rate that is recommended for rapier");
    }
}
