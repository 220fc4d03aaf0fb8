//! Evaluation of a walking policy: velocity errors, falls and the motion of the feet.
//!
//! A policy is judged by the measured velocity and by falls, never by its reward: policies that stand still collect
//! reward as well.

use serde::Serialize;
use twinstep_model::{EnvError, ResetRequest, RobotModel, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

use crate::walking::{Robots, Sums, Walker};

/// Measured motion of robots under a policy.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Evaluation {
    /// Number of robots.
    pub robots: usize,
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Share of the robots that did not fall.
    pub up: f64,
    /// Root mean square of the norm of the horizontal velocity error, of robots that are up [m/s].
    ///
    /// The error of one axis is smaller by √2.
    pub velocity_rms: f64,
    /// The same, without the first second after each change of the command [m/s].
    pub settled_velocity_rms: f64,
    /// Root mean square error of the yaw rate [rad/s].
    pub yaw_rate_rms: f64,
    /// The same, without the first second after each change of the command [rad/s].
    pub settled_yaw_rate_rms: f64,
    /// Median over swing phases of the highest position of the sole above the ground [m].
    pub swing_height: f64,
    /// Share of the time in which a foot is on the ground, mean over the feet, while a motion is commanded.
    pub duty_factor: f64,
    /// Swing phases per second and foot, while a motion is commanded [1/s].
    pub swings_per_second: f64,
    /// Mean speed of feet on the ground [m/s].
    pub slip_speed: f64,
    /// Mean of the mechanical power of all motors while a motion is commanded [W]. Braking counts as 0.
    ///
    /// The torque is that of the PD loop with nominal gains at the end of each policy step.
    pub power: f64,
    /// Errors by the commanded speed. [`SPEED_BINS`] are its ranges.
    pub by_speed: Vec<SpeedBin>,
}

/// Limits of the ranges of commanded speed, above standing robots [m/s].
pub const SPEED_BINS: [f32; 3] = [0.05, 0.4, 0.8];

/// Errors in a range of commanded speed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SpeedBin {
    /// Lowest commanded horizontal speed [m/s].
    pub from: f32,
    /// Share of the steps.
    pub share: f64,
    /// Root mean square of the norm of the horizontal velocity error [m/s].
    pub velocity_rms: f64,
    /// Root mean square error of the yaw rate [rad/s].
    pub yaw_rate_rms: f64,
}

/// The environment does not observe what the evaluation needs.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
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

/// Robots of an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationPlan<'a> {
    /// Model of the robots, for the lengths of their legs.
    pub robot: &'a RobotModel,
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Seed of robots and commands.
    pub seed: u64,
}

/// Runs the mean action of `policy` on all robots of `env`.
///
/// A robot that has fallen no longer counts for the errors. `proceed` is called after each step with the share that is
/// done; the evaluation stops if it returns false.
pub fn evaluate(
    policy: &Policy,
    env: &mut dyn VecEnv,
    plan: EvaluationPlan,
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<Evaluation, EvaluationError> {
    let EvaluationPlan { robot, seconds, seed } = plan;
    let spec = env.spec().clone();
    if spec.hash() != policy.spec.hash() {
        return Err(EvaluationError::OtherSpec { policy: policy.spec.hash(), env: spec.hash() });
    }
    let robots = Robots::new(&spec, robot)?;
    let num_envs = env.num_envs();
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut walkers = vec![Walker::default(); num_envs];
    let mut sums = Sums::default();
    let steps = (seconds / spec.policy_dt).round() as usize;
    for step in 0..steps {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions)?;
        for (index, walker) in walkers.iter_mut().enumerate() {
            walker.has_fallen |=
                batch.terminated[index] || batch.ended.iter().any(|end| end.env == index && end.diverged);
            // The observation of a robot whose time is over is that of its next episode.
            if !walker.has_fallen && !batch.done(index) {
                walker.add(&mut sums, &robots, index, [&obs, &batch.obs, &batch.critic_obs]);
            }
        }
        obs.copy_from_slice(&batch.obs);
        if !proceed((step + 1) as f64 / steps as f64) {
            return Err(EvaluationError::Stopped);
        }
    }
    let up = walkers.iter().filter(|walker| !walker.has_fallen).count();
    Ok(sums.evaluation(num_envs, up, seconds, spec.policy_dt))
}
