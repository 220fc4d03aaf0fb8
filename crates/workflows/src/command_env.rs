//! Simulated robots on which a policy follows command sequences: those of its task, `walk` or `gait`.

use twinstep_envs::{GaitConfig, GaitTask, TaskEnv, Walk, WalkConfig};
use twinstep_excite::{
    CommandRanges, CommandSequence, Limits, Trial, TrialError, gait_env, random_within_limits, simulate, walking_env,
};
use twinstep_measures::check_spec;
use twinstep_model::{RobotModel, VecEnv};
use twinstep_policy::Policy;
use twinstep_sim::{BatchBackend, SimConfig};

use crate::failure::{Failure, input};

/// Simulated robots of a policy's task.
pub enum CommandEnv {
    /// Robots that follow velocity commands.
    Walk(Box<TaskEnv<BatchBackend, Walk>>),
    /// Robots that follow velocity commands with a commanded gait.
    Gait(Box<TaskEnv<BatchBackend, GaitTask>>),
}

impl CommandEnv {
    /// Creates `robots` robots, or fails if `policy` is one of another task or of another robot.
    pub fn new(policy: &Policy, robot: &RobotModel, sim: SimConfig, robots: usize, seed: u64) -> Result<Self, Failure> {
        let backend = BatchBackend::new(robot.clone(), sim, robots).map_err(input)?;
        let env = if policy.spec.task == "gait" {
            Self::Gait(Box::new(gait_env(backend, seed).map_err(input)?))
        } else {
            Self::Walk(Box::new(walking_env(backend, seed).map_err(input)?))
        };
        let spec = match &env {
            Self::Walk(env) => env.spec(),
            Self::Gait(env) => env.spec(),
        };
        check_spec(policy, spec).map_err(input)?;
        Ok(env)
    }

    /// Lets `policy` follow one sequence on each robot.
    pub fn simulate(
        &mut self,
        policy: &Policy,
        sequences: &[CommandSequence],
        seed: u64,
    ) -> Result<Vec<Trial>, TrialError> {
        match self {
            Self::Walk(env) => simulate(env.as_mut(), policy, sequences, seed),
            Self::Gait(env) => simulate(env.as_mut(), policy, sequences, seed),
        }
    }

    /// Returns random commands with which the robots keep the limits, as [`random_within_limits`].
    pub fn random_within_limits(
        &mut self,
        policy: &Policy,
        segments: (f64, usize),
        limits: &Limits,
        seed: u64,
        proceed: &mut dyn FnMut() -> bool,
    ) -> Result<Option<CommandSequence>, TrialError> {
        let ranges = command_ranges(policy);
        match self {
            Self::Walk(env) => random_within_limits(env.as_mut(), policy, segments, &ranges, limits, seed, proceed),
            Self::Gait(env) => random_within_limits(env.as_mut(), policy, segments, &ranges, limits, seed, proceed),
        }
    }
}

/// Returns the ranges of the commands with which a policy of `walk` or `gait` is trained.
pub fn command_ranges(policy: &Policy) -> CommandRanges {
    let (command, step_frequency) = if policy.spec.task == "gait" {
        let GaitConfig { walk, step_frequency_hz, .. } = GaitConfig::default();
        (walk.command, Some(step_frequency_hz))
    } else {
        (WalkConfig::default().command, None)
    };
    let velocity = [command.linear_velocity_x, command.linear_velocity_y, command.angular_velocity_z];
    CommandRanges { velocity, step_frequency }
}
