//! Who builds the environments that a client asked for.

use twinstep_ensemble::{EnsembleError, ActuatorNetworkRobot};
use twinstep_envs::{CounterEnv, TaskEnv, TaskName, TaskEnvConfig};
use twinstep_model::effects::{SamplingError, RobotSampler};
use twinstep_model::{Actuator, AutoresetMode, ModelFile, ModelFileError, RobotModel, VecEnv};
use twinstep_sim::{BatchBackend, BackendBuildError, Engine, RapierBackend};

use crate::Config;

/// Builds environments.
pub trait EnvFactory: Send + Sync + 'static {
    /// `num_envs` environments; `max_episode_steps` in place of the task's own.
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError>;
}

/// Why environments could not be built.
#[derive(Debug, thiserror::Error)]
pub enum EnvFactoryError {
    /// The model file was refused.
    #[error(transparent)]
    Model(#[from] ModelFileError),
    /// The ensemble of the model file was refused.
    #[error("`actuator.ensemble`: {0}")]
    Ensemble(#[from] EnsembleError),
    /// A setting does not go with the model file's drives.
    #[error("`{field}` does not go with this model file: {reason}")]
    ActuatorNetwork {
        /// The key.
        field: &'static str,
        /// Why not.
        reason: &'static str,
    },
    /// The intervals of the model file are of hardly any robot.
    #[error("`randomise.effects`: {0}")]
    Draws(#[from] SamplingError),
    /// The simulation was refused.
    #[error(transparent)]
    Sim(#[from] BackendBuildError),
    /// The task was refused.
    #[error(transparent)]
    Task(#[from] twinstep_envs::ConfigError),
}

/// Builds simulated robots as a [`Config`] says.
pub struct SimEnvFactory {
    config: Config,
    robot: RobotModel,
    /// If an ensemble drives the robot.
    learned: Option<ActuatorNetworkRobot>,
    /// If effects are to be drawn anew in each episode.
    robots: Option<RobotSampler>,
    seed: u64,
}

impl SimEnvFactory {
    /// Reads the model file, and the ensemble that it names, and checks the simulation's settings.
    pub fn new(config: Config) -> Result<Self, EnvFactoryError> {
        let file = match &config.server.model {
            Some(path) => ModelFile::load(path)?,
            None => ModelFile::default(),
        };
        let learned = ActuatorNetworkRobot::load(&file)?;
        check_drives(&config, learned.as_ref())?;
        let robot = match &learned {
            Some(learned) => learned.robot.clone(),
            None => file.robot_model().expect("a file that was read is of a robot"),
        };
        config.sim.check(&robot.control).map_err(BackendBuildError::Config)?;
        let seed = config.server.seed.unwrap_or_else(crate::server::random_u64);
        let robots = if config.randomise.effects { Some(RobotSampler::new(file)?) } else { None };
        Ok(Self { config, robot, learned, robots, seed })
    }

    /// The learned drives of `num_envs` robots, if there are any.
    fn drives(&self, num_envs: usize) -> Option<Box<dyn Actuator>> {
        let uncertain = self.config.task.reward.uncertainty != 0.0;
        self.learned.as_ref().map(|learned| Box::new(learned.actuators(num_envs, uncertain)) as Box<dyn Actuator>)
    }
}

/// Fails if a setting asks of the drives what they cannot do.
fn check_drives(config: &Config, learned: Option<&ActuatorNetworkRobot>) -> Result<(), EnvFactoryError> {
    let refuse = |field, reason| Err(EnvFactoryError::ActuatorNetwork { field, reason });
    let Some(learned) = learned else {
        return match config.task.reward.uncertainty {
            0.0 => Ok(()),
            _ => refuse("task.reward.uncertainty", "without an `[actuator]` nothing is unknown about its drives"),
        };
    };
    let by_heart = "an ensemble knows its gains by heart; leave them at [1, 1]";
    if config.randomise.kp_scale != [1.0, 1.0] {
        return refuse("randomise.kp_scale", by_heart);
    }
    if config.randomise.kd_scale != [1.0, 1.0] {
        return refuse("randomise.kd_scale", by_heart);
    }
    if config.randomise.effects && learned.includes_rotor() {
        return refuse("randomise.effects", "its ensemble learnt behind the rotor, and drawn robots have one");
    }
    Ok(())
}

impl EnvFactory for SimEnvFactory {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        if self.config.task.name == TaskName::Counter {
            return Ok(Box::new(CounterEnv::new(&self.robot, num_envs, autoreset)));
        }
        let settings = TaskEnvConfig {
            task: self.config.task.clone(),
            randomise: self.config.randomise,
            robot_sampler: self.robots.clone(),
            autoreset,
            max_episode_steps,
            seed: self.seed,
        };
        let (robot, sim, drives) = (self.robot.clone(), self.config.sim, self.drives(num_envs));
        match sim.engine {
            Engine::Rapier => {
                let backend = RapierBackend::new(robot, sim, num_envs)?;
                let backend = if let Some(drives) = drives { backend.with_actuator(drives) } else { backend };
                Ok(Box::new(TaskEnv::new(backend, settings)?))
            }
            Engine::Batch => {
                let backend = BatchBackend::new(robot, sim, num_envs)?;
                let backend = if let Some(drives) = drives { backend.with_actuator(drives) } else { backend };
                Ok(Box::new(TaskEnv::new(backend, settings)?))
            }
        }
    }
}
