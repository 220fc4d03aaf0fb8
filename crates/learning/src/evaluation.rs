//! Evaluation of a walking policy: velocity errors, falls and the motion of the feet.
//!
//! A policy is judged by the measured velocity and by falls, never by its reward: policies that stand still collect
//! reward as well.

use twinstep_model::{EnvError, Feet, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

use crate::walking::{Evaluation, Robots, Sums, Walker};

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
    /// Feet of the robots.
    pub feet: &'a Feet,
    /// Torque limit of each joint [N·m].
    pub torque_limits: &'a [f64],
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
    let EvaluationPlan { feet, torque_limits, seconds, seed } = plan;
    let spec = env.spec().clone();
    if spec.hash() != policy.spec.hash() {
        return Err(EvaluationError::OtherSpec { policy: policy.spec.hash(), env: spec.hash() });
    }
    let robots = Robots::new(&spec, feet, torque_limits).map_err(EvaluationError::Missing)?;
    let num_envs = env.num_envs();
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut walkers = vec![Walker::new(feet.len()); num_envs];
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
    Ok(sums.evaluation(num_envs, up, seconds, &robots))
}
