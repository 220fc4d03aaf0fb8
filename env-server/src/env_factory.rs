//! Factories of the environments of a lease.

use twinstep_effects::{
    ControlTable, ModelFile, ModelFileError, NetworkMode, NominalRobotError, RobotSampler, SamplingError,
};
use twinstep_ensemble::{ActuatorNetworkRobot, EnsembleError};
use twinstep_envs::{
    Attitude, CounterEnv, GaitTask, Getup, Jump, Task, TaskConfig, TaskEnv, TaskEnvConfig, Track, Walk,
};
use twinstep_model::{Actuator, AutoresetMode, Backend, EnvSpec, RobotModel, VecEnv};
use twinstep_policy::array_file::ArrayFileError;
use twinstep_policy::{OtherBase, Policy, ResidualEnv};
use twinstep_sim::{
    BackendBuildError, BatchBackend, Engine, MujocoBackend, MujocoPlant, RapierBackend, SimConfigError, Terrain,
};

use twinstep_protocol::{message, random_u64};

use crate::Config;

/// Builds the environments of a lease.
pub trait EnvFactory: Send + Sync + 'static {
    /// Builds `num_envs` environments. `max_episode_steps` overrides the value of the task.
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError>;

    /// Returns what differs from a simulation. `None`: the environments are simulated.
    fn real_time(&self) -> Option<message::RealTime> {
        None
    }

    /// Stops the robot at once: its motors are damped. Never blocks. Returns false if there is no robot.
    fn stop(&self) -> bool {
        false
    }
}

/// Reasons why environments cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum EnvFactoryError {
    /// The model file is invalid.
    #[error(transparent)]
    Model(#[from] ModelFileError),
    /// The actuator network that the model file names is invalid.
    #[error("`actuator.ensemble`: {0}")]
    Ensemble(#[from] EnsembleError),
    /// A setting is not compatible with the actuators of the model file.
    #[error("`{field}` is not compatible with this model file: {reason}")]
    ActuatorNetwork {
        /// The key.
        field: &'static str,
        /// Why the setting is not compatible, and which value is allowed.
        reason: &'static str,
    },
    /// A setting is not one of robots of any tree.
    #[error("`{field}`: {reason}")]
    NotOfAnyTree {
        /// The key.
        field: &'static str,
        /// What is allowed.
        reason: &'static str,
    },
    /// A joint has no gain.
    #[error(
        "the model file states no `{key}` of joint `{joint}`: add `{key} = NUMBER`, or `{key} = {{ {joint} = NUMBER, ... }}`, to \
         its table `[control]`"
    )]
    NoGain {
        /// `kp` or `kd`.
        key: &'static str,
        /// The joint.
        joint: String,
    },
    /// The task is that of another factory.
    #[error(
        "the task `pose` is served by `twinstep serve --task pose`, in Rust by `TreeEnvFactory`; it has no other commands yet"
    )]
    TaskOfTrees,
    /// The contract does not fit the robot.
    #[error(transparent)]
    Control(#[from] NominalRobotError),
    /// A robot cannot do the task.
    #[error("`task.name` = \"{task}\" is not possible on a robot: {reason}")]
    NotOnRobots {
        /// Name of the task.
        task: &'static str,
        /// What a robot lacks.
        reason: &'static str,
    },
    /// A contract is given for a robot of another shape.
    #[error("`control` and `--contract` are for quadrupeds; the model file of this robot states its own [control]")]
    ContractOfQuadrupeds,
    /// Too few samples from the intervals of the model file are valid robots.
    #[error("`randomise.effects`: {0}")]
    Draws(#[from] SamplingError),
    /// The simulation settings are invalid.
    #[error(transparent)]
    Sim(#[from] BackendBuildError),
    /// The base policy cannot be read.
    #[error("`task.base`: {0}")]
    Base(#[from] ArrayFileError),
    /// The base policy does not fit the robot.
    #[error("`task.base`: {0}")]
    OtherBase(#[from] OtherBase),
    /// The task settings are invalid.
    #[error(transparent)]
    Task(#[from] twinstep_envs::ConfigError),
}

/// Builds simulated environments from a [`Config`].
pub struct SimEnvFactory {
    config: Config,
    robot: RobotModel,
    /// `None` if the robot is simulated with the analytic actuator model.
    learned: Option<ActuatorNetworkRobot>,
    /// `None` unless the effects are sampled in each episode.
    robots: Option<RobotSampler>,
    seed: u64,
    /// Base policy of the task `explore`.
    base: Option<Policy>,
    /// True if actuator networks estimate their epistemic uncertainty.
    estimates_uncertainty: bool,
}

impl SimEnvFactory {
    /// Reads the model file and the actuator network that it names, and checks the simulation settings.
    pub fn new(config: Config) -> Result<Self, EnvFactoryError> {
        if let TaskConfig::Pose(_) = config.task {
            return Err(EnvFactoryError::TaskOfTrees);
        }
        let file = match &config.server.model {
            Some(path) => ModelFile::load(path)?,
            None => ModelFile::default(),
        };
        let control = config.control.clone().unwrap_or_default();
        let file = match control.action_scale.or(config.task.action_scale()) {
            None if config.control.is_none() => file,
            action_scale => file.with_control(&ControlTable { action_scale, ..control })?,
        };
        let learned = ActuatorNetworkRobot::load(&file)?;
        check_actuators(&config, learned.as_ref())?;
        let robot = match &learned {
            Some(learned) => learned.robot.clone(),
            None => file.robot_model().expect("the model file was checked when it was read"),
        };
        config.sim.check(robot.control.actuator_hz).map_err(BackendBuildError::Config)?;
        if let (Terrain::Course(_), TaskConfig::Track(_) | TaskConfig::Jump(_)) = (config.sim.terrain, &config.task) {
            // Their paths and targets are about the origin.
            let (field, value) = ("terrain", format!("course with the task `{}`", config.task.name()));
            let allowed = "a course for the tasks `walk`, `gait`, `attitude` and `explore`".to_owned();
            return Err(BackendBuildError::Config(SimConfigError { field, value, allowed }).into());
        }
        let seed = config.server.seed.unwrap_or_else(random_u64);
        let robots = if config.randomise.effects { Some(RobotSampler::new(file)?) } else { None };
        let base = match &config.task {
            TaskConfig::Explore(explore) => Some(Policy::read(&explore.base)?.0),
            _ => None,
        };
        let estimates_uncertainty = config.task.epistemic_uncertainty_weight().1 != 0.0;
        Ok(Self { config, robot, learned, robots, seed, base, estimates_uncertainty })
    }

    /// Lets actuator networks estimate their epistemic uncertainty also where it is no reward.
    pub fn estimating_uncertainty(self) -> Self {
        Self { estimates_uncertainty: true, ..self }
    }

    /// Returns the nominal robot.
    pub fn robot(&self) -> &RobotModel {
        &self.robot
    }

    /// Returns the actuator networks of `num_envs` robots, or `None` if the actuators are analytic.
    fn actuators(&self, num_envs: usize) -> Option<Box<dyn Actuator>> {
        let networks = |learned: &ActuatorNetworkRobot| learned.actuators(num_envs, self.estimates_uncertainty);
        self.learned.as_ref().map(|learned| Box::new(networks(learned)) as Box<dyn Actuator>)
    }
}

/// Checks that the settings are compatible with the actuators of the robot.
fn check_actuators(config: &Config, learned: Option<&ActuatorNetworkRobot>) -> Result<(), EnvFactoryError> {
    let reject = |field, reason| Err(EnvFactoryError::ActuatorNetwork { field, reason });
    let Some(learned) = learned else {
        return match config.task.epistemic_uncertainty_weight() {
            (_, 0.0) => Ok(()),
            (field, _) => reject(field, "it has no `[actuator]`, so there is no epistemic uncertainty; use 0"),
        };
    };
    let fixed_gains = "its actuator network is trained for one pair of gains; use [1, 1]";
    if learned.has_fixed_gains() && config.randomise.kp_scale != [1.0, 1.0] {
        return reject("randomise.kp_scale", fixed_gains);
    }
    if learned.has_fixed_gains() && config.randomise.kd_scale != [1.0, 1.0] {
        return reject("randomise.kd_scale", fixed_gains);
    }
    if learned.mode() == NetworkMode::Replace && config.randomise.command_delay_ms != [0.0, 0.0] {
        let reason = "its actuator network includes the delay of the robot it was trained with; use [0, 0]";
        return reject("randomise.command_delay_ms", reason);
    }
    if config.randomise.effects && learned.includes_rotor() {
        return reject(
            "randomise.effects",
            "its actuator network includes the rotor inertia, which sampled robots have as well; use false",
        );
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
        if self.config.task == TaskConfig::Counter {
            return Ok(Box::new(CounterEnv::new(&self.robot, num_envs, autoreset)));
        }
        let (robot, sim, actuators) = (self.robot.clone(), self.config.sim, self.actuators(num_envs));
        let settings = TaskEnvConfig {
            randomise: self.config.randomise,
            robot_sampler: self.robots.clone(),
            autoreset,
            max_episode_steps,
            seed: self.seed,
        };
        let env = match sim.engine {
            Engine::Rapier => {
                let backend = RapierBackend::new(robot, sim, num_envs)?;
                let backend = if let Some(actuators) = actuators { backend.with_actuator(actuators) } else { backend };
                task_env(&self.config.task, backend, settings)
            }
            Engine::Batch => {
                let backend = BatchBackend::new(robot, sim, num_envs)?;
                let backend = if let Some(actuators) = actuators { backend.with_actuator(actuators) } else { backend };
                task_env(&self.config.task, backend, settings)
            }
            Engine::Mujoco if actuators.is_none() && MujocoBackend::simulates(&robot) => {
                task_env(&self.config.task, MujocoBackend::new(robot, sim, num_envs)?, settings)
            }
            Engine::Mujoco => {
                let backend = MujocoPlant::new(robot, sim, num_envs)?;
                let backend = if let Some(actuators) = actuators { backend.with_actuator(actuators) } else { backend };
                task_env(&self.config.task, backend, settings)
            }
        }?;
        match (&self.config.task, &self.base) {
            (TaskConfig::Explore(explore), Some(base)) => {
                Ok(Box::new(ResidualEnv::new(env, "explore", base, explore.max_residual)?))
            }
            _ => Ok(env),
        }
    }
}

/// Returns the spec of a task on a robot. Without ground truth some reward terms and the critic group are missing.
pub fn task_spec(config: &TaskConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<EnvSpec, EnvFactoryError> {
    Ok(match config.clone() {
        TaskConfig::Walk(config) => Walk::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Track(config) => Track::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Jump(config) => Jump::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Gait(config) => GaitTask::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Attitude(config) => Attitude::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Getup(config) => Getup::new(config, robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Explore(config) => Walk::new(config.weighted_walk(), robot, has_ground_truth)?.spec().clone(),
        TaskConfig::Pose(_) | TaskConfig::Counter => return Err(EnvFactoryError::TaskOfTrees),
    })
}

/// Checks that a robot measures what a task observes.
pub fn check_measurable(config: &TaskConfig) -> Result<(), EnvFactoryError> {
    let reason = match config {
        TaskConfig::Walk(_) | TaskConfig::Gait(_) | TaskConfig::Jump(_) | TaskConfig::Attitude(_) => return Ok(()),
        // Without motion capture the policy follows the velocity of the path alone.
        TaskConfig::Track(track) if !track.observe_pose_error => return Ok(()),
        TaskConfig::Track(_) => {
            "it observes its position on the path, which no sensor of the robot measures: set `observe_pose_error = false`"
        }
        TaskConfig::Explore(_) => "its reward needs actuator networks; run the policy that it trained as `walk`",
        TaskConfig::Getup(_) => "the driver stops the motors of a robot that lies",
        TaskConfig::Pose(_) => "it is for simulated robots of any shape",
        TaskConfig::Counter => "it has no robot",
    };
    Err(EnvFactoryError::NotOnRobots { task: config.name(), reason })
}

/// Builds the environments of the configured task on a backend.
pub fn task_env(
    config: &TaskConfig,
    backend: impl Backend + 'static,
    settings: TaskEnvConfig,
) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
    let (robot, has_ground_truth) = (backend.robot(), backend.ground_truth().is_some());
    match config {
        TaskConfig::Walk(config) => {
            let walk = Walk::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, walk, settings)?))
        }
        TaskConfig::Track(config) => {
            let track = Track::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, track, settings)?))
        }
        TaskConfig::Jump(config) => {
            let jump = Jump::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, jump, settings)?))
        }
        TaskConfig::Gait(config) => {
            let gait = GaitTask::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, gait, settings)?))
        }
        TaskConfig::Attitude(config) => {
            let attitude = Attitude::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, attitude, settings)?))
        }
        TaskConfig::Getup(config) => {
            let getup = Getup::new(config.clone(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, getup, settings)?))
        }
        // The environments of the base policy; the residual is added to its actions by `ResidualEnv`.
        TaskConfig::Explore(config) => {
            let walk = Walk::new(config.weighted_walk(), robot, has_ground_truth)?;
            Ok(Box::new(TaskEnv::new(backend, walk, settings)?))
        }
        TaskConfig::Counter => Ok(Box::new(CounterEnv::new(robot, backend.num_robots(), settings.autoreset))),
        TaskConfig::Pose(_) => Err(EnvFactoryError::TaskOfTrees),
    }
}
