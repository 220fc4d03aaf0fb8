//! Environments whose robots are seen while an agent steps them.

use std::sync::Arc;

use twinstep_model::{
    AutoresetMode, EnvError, EnvSpec, GaitCommand, RealTimeReport, ResetRequest, RobotSample, Scene, StepBatch, VecEnv,
    VelocityCommand,
};

use crate::frame::{Frame, RobotFrame};
use crate::hub::Hub;

/// Largest number of robots that a page shows.
pub const MAX_ROBOTS: usize = 64;

/// Environments that publish their robots before a step, as often as a page can show them.
///
/// They are looked at only: no request of a page reaches them.
pub struct WatchedVecEnv {
    env: Box<dyn VecEnv>,
    hub: Arc<Hub>,
    /// Number at the hub, of which the largest is shown.
    number: u64,
    steps: u64,
    /// Mean reward of the last step.
    reward: f32,
    /// Falls and robot-steps since the last frame.
    falls: [u64; 2],
}

impl WatchedVecEnv {
    /// Lets the pages of `hub` see the first [`MAX_ROBOTS`] robots of `env`.
    pub fn new(env: Box<dyn VecEnv>, hub: Arc<Hub>) -> Self {
        Self { env, number: hub.take_over(), hub, steps: 0, reward: 0.0, falls: [0; 2] }
    }

    fn publish(&mut self) {
        let robots = (0..self.env.num_envs().min(MAX_ROBOTS)).map(|robot| self.env.scene(robot));
        // Robots that were not reset yet have no pose.
        let robots: Result<Vec<_>, _> = robots.map(|scene| scene.map(|scene| RobotFrame::of_scene(&scene))).collect();
        let Ok(robots) = robots else { return };
        let policy_dt = self.env.spec().policy_dt;
        let [falls, steps] = std::mem::take(&mut self.falls);
        let minutes = steps as f64 * policy_dt / 60.0;
        let mut curves = vec![("reward per step".to_owned(), f64::from(self.reward))];
        if minutes > 0.0 {
            curves.push(("falls per minute and robot".to_owned(), falls as f64 / minutes));
        }
        curves.extend(velocity_error(&robots).map(|error| ("velocity error [m/s]".to_owned(), error)));
        self.hub.publish(&Frame { time: self.steps as f64 * policy_dt, robots, curves, playback: None });
    }
}

/// Returns the root mean square error of the forward and left velocity [m/s], if commands and velocities are known.
fn velocity_error(robots: &[RobotFrame]) -> Option<f64> {
    let square = |robot: &RobotFrame| {
        let (command, velocity) = (robot.command?, robot.velocity?);
        Some((0..2).map(|axis| f64::from(command[axis] - velocity[axis]).powi(2)).sum::<f64>())
    };
    let squares: Vec<f64> = robots.iter().filter_map(square).collect();
    (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
}

impl VecEnv for WatchedVecEnv {
    fn spec(&self) -> &EnvSpec {
        self.env.spec()
    }

    fn num_envs(&self) -> usize {
        self.env.num_envs()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.env.autoreset()
    }

    fn mean_level(&self) -> Option<f64> {
        self.env.mean_level()
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        self.env.reset(request)
    }

    fn obs(&self) -> &[f32] {
        self.env.obs()
    }

    fn critic_obs(&self) -> &[f32] {
        self.env.critic_obs()
    }

    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.env.set_velocity_commands(commands)
    }

    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.env.set_gait_commands(commands)
    }

    fn set_action_tick(&mut self, tick: u64) {
        self.env.set_action_tick(tick);
    }

    fn real_time(&self) -> Option<&RealTimeReport> {
        self.env.real_time()
    }

    fn push(&mut self, env: usize, velocity: [f32; 3]) -> Result<(), EnvError> {
        self.env.push(env, velocity)
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        if self.hub.is_due() && self.hub.shows(self.number) {
            self.publish();
        }
        let batch = self.env.step(actions)?;
        self.steps += 1;
        self.reward = batch.reward.iter().sum::<f32>() / batch.reward.len().max(1) as f32;
        self.falls[0] += batch.terminated.iter().filter(|fell| **fell).count() as u64;
        self.falls[1] += batch.reward.len() as u64;
        Ok(batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        self.env.scene(env)
    }

    fn samples(&mut self, env: usize) -> Result<Vec<RobotSample>, EnvError> {
        self.env.samples(env)
    }
}
