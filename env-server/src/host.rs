//! Who builds the environments that a client asked for.

use twinstep_envs::{CounterEnv, TaskEnv, TaskName, TaskSettings};
use twinstep_model::effects::{DrawError, RobotDraws};
use twinstep_model::{AutoresetMode, ModelFile, ModelFileError, RobotModel, VecEnv};
use twinstep_sim::{BatchBackend, BuildError, Engine, RapierBackend};

use crate::Config;

/// Builds environments.
pub trait Host: Send + Sync + 'static {
    /// `num_envs` environments; `max_episode_steps` in place of the task's own.
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, HostError>;
}

/// Why environments could not be built.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// The model file was refused.
    #[error(transparent)]
    Model(#[from] ModelFileError),
    /// The intervals of the model file are of hardly any robot.
    #[error("`randomise.effects`: {0}")]
    Draws(#[from] DrawError),
    /// The simulation was refused.
    #[error(transparent)]
    Sim(#[from] BuildError),
    /// The task was refused.
    #[error(transparent)]
    Task(#[from] twinstep_envs::ConfigError),
}

/// Builds simulated robots as a [`Config`] says.
pub struct SimHost {
    config: Config,
    robot: RobotModel,
    /// If effects are to be drawn anew in each episode.
    robots: Option<RobotDraws>,
    seed: u64,
}

impl SimHost {
    /// Reads the model file and checks the simulation's settings.
    pub fn new(config: Config) -> Result<Self, HostError> {
        let file = match &config.server.model {
            Some(path) => ModelFile::load(path)?,
            None => ModelFile::default(),
        };
        let robot = file.robot_model().expect("a file that was read is of a robot");
        config.sim.check(&robot.control).map_err(BuildError::Config)?;
        let seed = config.server.seed.unwrap_or_else(crate::server::random_u64);
        let robots = if config.randomise.effects { Some(RobotDraws::new(file)?) } else { None };
        Ok(Self { config, robot, robots, seed })
    }
}

impl Host for SimHost {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, HostError> {
        match self.config.task.name {
            TaskName::Counter => Ok(Box::new(CounterEnv::new(&self.robot, num_envs, autoreset))),
            TaskName::Walk => {
                let settings = TaskSettings {
                    task: self.config.task.clone(),
                    randomise: self.config.randomise,
                    robots: self.robots.clone(),
                    autoreset,
                    max_episode_steps,
                    seed: self.seed,
                };
                let (robot, sim) = (self.robot.clone(), self.config.sim);
                match sim.engine {
                    Engine::Rapier => Ok(Box::new(TaskEnv::new(RapierBackend::new(robot, sim, num_envs)?, settings)?)),
                    Engine::Batch => Ok(Box::new(TaskEnv::new(BatchBackend::new(robot, sim, num_envs)?, settings)?)),
                }
            }
        }
    }
}
