//! Builds environments on the real robot.

use twinstep_env_server::{EnvFactory, EnvFactoryError, task_env, task_spec};
use twinstep_envs::{TaskConfig, TaskEnvConfig};
use twinstep_model::{AutoresetMode, RobotModel, VecEnv};
use twinstep_protocol::message::RealTime;
use twinstep_robot::{RobotBackend, RobotHandle};

/// Builds the environment of the client that has the robot.
pub struct RobotEnvFactory {
    /// The nominal robot, with the gains and periods of the policy.
    pub robot: RobotModel,
    /// Settings of the task.
    pub task: TaskConfig,
    /// The robot's control loop.
    pub handle: RobotHandle,
}

impl RobotEnvFactory {
    /// Returns the reward terms that only a simulator can compute.
    fn absent_reward_terms(&self) -> Vec<String> {
        let terms = |truth| task_spec(&self.task, &self.robot, truth).map(|spec| spec.reward_terms).unwrap_or_default();
        let measured = terms(false);
        terms(true).into_iter().filter(|term| !measured.contains(term)).collect()
    }
}

impl EnvFactory for RobotEnvFactory {
    fn build(
        &self,
        _num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let settings = TaskEnvConfig { max_episode_steps, ..TaskEnvConfig::new(autoreset, 0) };
        let backend = RobotBackend::new(self.robot.clone(), self.handle.clone());
        task_env(&self.task, backend, settings)
    }

    fn real_time(&self) -> Option<RealTime> {
        let state = self.handle.board().state;
        Some(RealTime {
            absent_reward_terms: self.absent_reward_terms(),
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
