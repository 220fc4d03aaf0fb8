//! Builds environments on the real robot.

use twinstep_env_server::{EnvFactory, EnvFactoryError};
use twinstep_envs::reward::NEED_GROUND_TRUTH;
use twinstep_envs::{Randomisation, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_model::{AutoresetMode, RobotModel, VecEnv};
use twinstep_protocol::message::RealTime;
use twinstep_robot::{RobotBackend, RobotHandle};

/// Builds the environment of the client that has the robot.
pub struct RobotEnvFactory {
    /// The nominal robot, with the gains and periods of the policy.
    pub robot: RobotModel,
    /// Settings of the task.
    pub task: WalkConfig,
    /// The robot's control loop.
    pub handle: RobotHandle,
}

impl EnvFactory for RobotEnvFactory {
    fn build(
        &self,
        _num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let walk = Walk::new(self.task.clone(), &self.robot, false)?;
        let settings = TaskEnvConfig {
            randomise: Randomisation::default(),
            robot_sampler: None,
            autoreset,
            max_episode_steps,
            seed: 0,
        };
        let backend = RobotBackend::new(self.robot.clone(), self.handle.clone());
        Ok(Box::new(TaskEnv::new(backend, walk, settings)?))
    }

    fn real_time(&self) -> Option<RealTime> {
        let state = self.handle.board().state;
        Some(RealTime {
            absent_reward_terms: NEED_GROUND_TRUTH.map(str::to_owned).to_vec(),
            absent_ends: vec!["min_base_height_m".to_owned()],
            state: state.map_or_else(|| "starting".to_owned(), |state| state.to_string()),
            stop_port: None,
        })
    }

    fn stop(&self) -> bool {
        self.handle.stop();
        true
    }
}
