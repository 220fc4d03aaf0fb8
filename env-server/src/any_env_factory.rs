//! Factory of the environments of any robot.

use std::path::Path;

use twinstep_effects::{ModelFile, ModelFileError, NominalRobotError};
use twinstep_envs::{ControlledRobot, TaskConfig};
use twinstep_model::{AutoresetMode, RobotModel, VecEnv};

use crate::{Config, EnvFactory, EnvFactoryError, SimEnvFactory, TreeEnvFactory};

/// Builds simulated environments of any robot: those of a quadruped like the Go2 in the engine that knows its shape.
pub enum AnyEnvFactory {
    /// A quadruped like the Go2.
    Quadruped(Box<SimEnvFactory>),
    /// A robot of any tree.
    Tree(Box<TreeEnvFactory>),
}

impl AnyEnvFactory {
    /// Reads the model file and checks the settings.
    pub fn new(config: Config) -> Result<Self, EnvFactoryError> {
        let is_tree = match &config.task {
            TaskConfig::Pose(_) => true,
            _ => config.server.model.as_deref().is_some_and(is_of_tree),
        };
        if is_tree {
            return Ok(Self::Tree(Box::new(TreeEnvFactory::new(&config)?)));
        }
        Ok(Self::Quadruped(Box::new(SimEnvFactory::new(config)?)))
    }

    /// Returns the robot as its task sees it.
    pub fn control(&self) -> ControlledRobot {
        match self {
            Self::Quadruped(factory) => ControlledRobot::from(factory.robot()),
            Self::Tree(factory) => factory.control().clone(),
        }
    }

    /// Returns the quadruped; `None` for a robot of any tree.
    pub fn quadruped(&self) -> Option<&RobotModel> {
        match self {
            Self::Quadruped(factory) => Some(factory.robot()),
            Self::Tree(_) => None,
        }
    }
}

impl EnvFactory for AnyEnvFactory {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        match self {
            Self::Quadruped(factory) => factory.build(num_envs, autoreset, max_episode_steps),
            Self::Tree(factory) => factory.build(num_envs, autoreset, max_episode_steps),
        }
    }
}

/// Returns true if the robot of a model file has not the shape of the Go2.
///
/// A file with another mistake counts as one of a quadruped: whoever reads it says what is wrong.
pub fn is_of_tree(model: &Path) -> bool {
    // Whoever reads the file for its robot says what it leaves out.
    let silent = tracing::subscriber::NoSubscriber::default();
    match tracing::subscriber::with_default(silent, || ModelFile::load(model)) {
        Err(ModelFileError::OfTree { .. }) => true,
        Err(ModelFileError::Robot { cause, .. }) => matches!(*cause, NominalRobotError::Import { .. }),
        _ => false,
    }
}
