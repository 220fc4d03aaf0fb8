//! What a policy does, measured by one loop.
//!
//! - [`measure`]: steps all robots of an environment with the mean action of a policy, and shows each step to a [`Measure`].
//! - [`Walking`], [`Tracking`], [`GaitFollowing`], [`AttitudeFollowing`], [`Jumping`], [`GettingUp`], [`PoseFollowing`]: a measure for each task.
//! - [`CourseWalking`]: how steep and high a ground a policy of `walk` masters.
//! - [`conditions`]: the robots, grounds and disturbances under which a policy is judged.
//!
//! A policy is judged by what the robots do and by falls, never by its reward: policies that stand still collect reward as well.
//! A new task brings one file with one measure.

mod attitude;
mod conditions;
mod course;
mod gait;
mod getup;
mod jump;
mod pose;
mod tracking;
mod walking;

pub use attitude::{AttitudeErrors, AttitudeFollowing};
pub use conditions::{CONDITION_NAMES, Condition, conditions};
pub use course::{CourseWalking, KindOfGround, Level};
pub use gait::{GaitFollowing, GaitMotion};
pub use getup::{GETUP_S, GettingUp, GettingUpTimes};
pub use jump::{JUMP_S, Jumping, Landings};
pub use pose::{PoseErrors, PoseFollowing};
pub use tracking::{Tracking, TrackingErrors};
pub use walking::{Evaluation, SpeedBin, Walking};

use twinstep_model::{EnvError, EnvSpec, ResetRequest, Scene, StepBatch, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

/// A policy cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum MeasureError {
    /// The policy is for other robots or observations.
    #[error(
        "the policy was trained with spec {policy}, the environment has {env}; they must agree on observation, action, \
         gains, action scale and default pose"
    )]
    OtherSpec {
        /// Hash of the policy's spec.
        policy: String,
        /// Hash of the environment's spec.
        env: String,
    },
    /// A part of the observation is missing.
    #[error("the environment does not observe `{0}`, which the evaluation needs")]
    Missing(&'static str),
    /// The caller stopped the evaluation.
    #[error("the evaluation was stopped")]
    Stopped,
    /// The environment failed.
    #[error(transparent)]
    Env(#[from] EnvError),
}

/// How long robots are measured, and from which seed.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Seed of robots and commands.
    pub seed: u64,
}

/// A step of all robots.
pub struct Step<'a> {
    /// Number of the step.
    pub index: usize,
    /// Observations of all robots before the step, from which the policy chose its actions.
    pub before: &'a [f32],
    /// What the step returned.
    pub batch: &'a StepBatch,
    env: &'a mut dyn VecEnv,
    has_fallen: &'a [bool],
}

impl Step<'_> {
    /// Returns the robots that count: those that have not fallen, without those whose episode is over, because their observation
    /// is that of the next one.
    pub fn robots(&self) -> Vec<usize> {
        (0..self.has_fallen.len()).filter(|robot| !self.has_fallen[*robot] && !self.batch.done(*robot)).collect()
    }

    /// Returns the bodies and the ground of a robot after the step.
    pub fn scene(&mut self, robot: usize) -> Result<Scene, EnvError> {
        self.env.scene(robot)
    }
}

/// Something that robots under a policy do.
pub trait Measure {
    /// What is measured.
    type Found;

    /// Adds a step of the robots.
    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError>;

    /// Returns what was measured. `has_fallen` is true for a robot that fell.
    fn found(self, has_fallen: &[bool]) -> Self::Found;
}

/// Runs the mean action of `policy` on all robots of `env`, and measures what they do.
///
/// A robot has fallen if the task ends its episode, or its simulation diverges; the end of an episode by time is no fall.
/// `proceed` is called after each step with the share that is done; the evaluation stops if it returns false.
pub fn measure<M: Measure>(
    policy: &Policy,
    env: &mut dyn VecEnv,
    mut measure: M,
    Run { seconds, seed }: Run,
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<M::Found, MeasureError> {
    check_spec(policy, env.spec())?;
    let (num_envs, policy_dt) = (env.num_envs(), env.spec().policy_dt);
    let mut runner = PolicyRunner::new(policy);
    let mut actions = vec![0.0; num_envs * env.spec().action_len()];
    let mut before = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut batch = StepBatch::default();
    let mut has_fallen = vec![false; num_envs];
    let steps = (seconds / policy_dt).round() as usize;
    for index in 0..steps {
        runner.run(&before, &mut actions);
        batch.clone_from(env.step(&actions)?);
        for (robot, has_fallen) in has_fallen.iter_mut().enumerate() {
            *has_fallen |= batch.terminated[robot] || batch.ended.iter().any(|end| end.env == robot && end.diverged);
        }
        measure.add(&mut Step { index, before: &before, batch: &batch, env, has_fallen: &has_fallen })?;
        before.copy_from_slice(&batch.obs);
        if !proceed((index + 1) as f64 / steps as f64) {
            return Err(MeasureError::Stopped);
        }
    }
    Ok(measure.found(&has_fallen))
}

/// Fails unless the policy is one of the environments' task and robot.
pub fn check_spec(policy: &Policy, env: &EnvSpec) -> Result<(), MeasureError> {
    if policy.spec.hash() == env.hash() {
        return Ok(());
    }
    Err(MeasureError::OtherSpec { policy: policy.spec.hash(), env: env.hash() })
}

/// Returns the share of the robots that did not fall.
fn share_up(has_fallen: &[bool]) -> f64 {
    has_fallen.iter().filter(|has_fallen| !**has_fallen).count() as f64 / has_fallen.len() as f64
}
