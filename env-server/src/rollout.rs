//! Rollouts: a policy is run next to the environments.

use std::sync::atomic::Ordering;

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, Trajectory, VecEnv};
use twinstep_policy::{ActionSampler, BehaviourPolicy, Mlp, Normaliser};
use twinstep_protocol::{ErrorCode, ErrorReply, convert, message, tensor};

use crate::dispatch::shutting_down;
use crate::messages::ServerState;

/// Maximum number of layers, and of units of a layer, of a policy.
const MAX_LAYERS: usize = 16;
const MAX_UNITS: u64 = 65_536;
/// Limit of the logarithm of a standard deviation.
const MAX_LOG_STD: f32 = 20.0;
/// Maximum size of a trajectory without its ended episodes [bytes]. Zenoh refuses messages of more than 1 GiB.
const MAX_TRAJECTORY_BYTES: u64 = 1 << 29;

/// Runs the policy of `request`, or `held`, the last policy with its id. The steps are written to `trajectory`.
///
/// Returns the policy if it is a new one. An error after the first step is [`ErrorCode::RolloutFailed`].
pub fn run(
    request: &message::RolloutRequest<'_>,
    held: Option<&(u64, BehaviourPolicy)>,
    env: &mut dyn VecEnv,
    state: &ServerState,
    trajectory: &mut Trajectory,
) -> Result<Option<BehaviourPolicy>, ErrorReply> {
    let steps = check_steps(request.steps, env, state.max_rollout_steps)?;
    let new = request.policy.as_ref().map(|policy| read_policy(policy, env.spec())).transpose()?;
    let policy = match &new {
        Some(policy) => policy,
        None => held_policy(request.policy_id, held)?,
    };
    trajectory.start(steps, env.spec(), env.obs(), env.critic_obs());
    let mut sampler = ActionSampler::new(policy, request.noise_seed, env.num_envs());
    for step in 0..steps {
        if state.shutting_down.load(Ordering::Acquire) {
            return Err(shutting_down());
        }
        sampler.step(env, trajectory).map_err(|error| failed(step, steps, &error))?;
        state.env_steps.fetch_add(env.num_envs() as u64, Ordering::Relaxed);
    }
    Ok(new)
}

/// Checks the number of steps, and that episodes are restarted by the environments.
fn check_steps(steps: u64, env: &dyn VecEnv, limit: usize) -> Result<usize, ErrorReply> {
    let reject =
        |field, message: String, hint| Err(ErrorReply::new(ErrorCode::OutOfRange, field, message).with_hint(hint));
    if env.autoreset() == AutoresetMode::Disabled {
        let message = "the lease has autoreset `Disabled`; a rollout needs `NextStep` or `SameStep`".to_owned();
        return reject("autoreset", message, "request a lease with another autoreset mode");
    }
    if !(1..=limit as u64).contains(&steps) {
        let message = format!("`steps` = {steps} is not allowed: 1 to {limit}, `max_rollout_steps` of this server");
        return reject("steps", message, "divide the rollout, or start the server with a larger `--max-rollout-steps`");
    }
    let spec = env.spec();
    let entries = spec.obs_len() + spec.critic_obs_len() + spec.action_len() + 3;
    let bytes = (steps + 1) * (env.num_envs() * entries * size_of::<f32>()) as u64;
    if bytes > MAX_TRAJECTORY_BYTES {
        let message =
            format!("`steps` = {steps} gives a reply of {bytes} bytes; at most {MAX_TRAJECTORY_BYTES} are sent");
        return reject("steps", message, "divide the rollout");
    }
    Ok(steps as usize)
}

fn held_policy(id: Option<u64>, held: Option<&(u64, BehaviourPolicy)>) -> Result<&BehaviourPolicy, ErrorReply> {
    let Some(id) = id else {
        return Err(ErrorReply::new(
            ErrorCode::Malformed,
            "policy",
            "the request has neither `policy` nor `policy_id`",
        ));
    };
    held.filter(|(held, _)| *held == id).map(|(_, policy)| policy).ok_or_else(|| {
        let held = held.map_or("no policy".to_owned(), |(held, _)| format!("only that of number {held}"));
        let message = format!("`policy_id` = {id} is not held: the lease holds {held}");
        ErrorReply::new(ErrorCode::UnknownPolicy, "policy_id", message).with_hint("send the `policy`")
    })
}

/// Decodes a policy for the observations and actions of `spec`.
fn read_policy(policy: &message::RolloutPolicy<'_>, spec: &EnvSpec) -> Result<BehaviourPolicy, ErrorReply> {
    let sizes = read_sizes(&policy.sizes, spec)?;
    let mean = read_finite(policy.mean, "policy.mean", spec.obs_len())?;
    let std = read_finite(policy.std, "policy.std", spec.obs_len())?;
    let log_std = read_finite(policy.log_std, "policy.log_std", spec.action_len())?;
    let reject = |field, message| Err(ErrorReply::new(ErrorCode::OutOfRange, field, message));
    if let Some(value) = std.iter().find(|value| **value <= 0.0) {
        return reject("policy.std", format!("`policy.std` has {value}, which must be positive"));
    }
    if let Some(value) = log_std.iter().find(|value| value.abs() > MAX_LOG_STD) {
        return reject(
            "policy.log_std",
            format!("`policy.log_std` has {value}; allowed: −{MAX_LOG_STD} to {MAX_LOG_STD}"),
        );
    }
    let expected = Mlp::num_weights(&sizes).unwrap_or(usize::MAX);
    let weights = read_finite(policy.weights, "policy.weights", expected)?;
    let actor = Mlp::from_weights(&sizes, &weights).expect("sizes and number of weights were checked");
    Ok(BehaviourPolicy::new(actor, Normaliser::from_mean_and_std(&mean, &std), log_std))
}

fn read_sizes(sizes: &[u64], spec: &EnvSpec) -> Result<Vec<usize>, ErrorReply> {
    let ends = (sizes.first().copied(), sizes.last().copied());
    let expected = (Some(spec.obs_len() as u64), Some(spec.action_len() as u64));
    let in_range = sizes.iter().all(|size| (1..=MAX_UNITS).contains(size));
    if ends == expected && in_range && (2..=MAX_LAYERS + 1).contains(&sizes.len()) {
        return Ok(sizes.iter().map(|size| *size as usize).collect());
    }
    let message = format!(
        "`policy.sizes` = {sizes:?} is not allowed: {} inputs, hidden layers of 1 to {MAX_UNITS} units, {} outputs, \
         at most {MAX_LAYERS} layers",
        spec.obs_len(),
        spec.action_len(),
    );
    Err(ErrorReply::new(ErrorCode::OutOfRange, "policy.sizes", message))
}

/// Decodes `expected` numbers. The length is checked before they are copied.
fn read_finite(bytes: &[u8], field: &'static str, expected: usize) -> Result<Vec<f32>, ErrorReply> {
    convert::check_length(field, bytes.len() / size_of::<f32>(), expected)?;
    let values: Vec<f32> = tensor::read(bytes, field)?;
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(values),
        Some(index) => {
            let message = format!("`{field}`: entry {index} is {}, but must be finite", values[index]);
            Err(ErrorReply::new(ErrorCode::NotFinite, field, message).with_hint("check the learner"))
        }
    }
}

/// Returns the error reply to a rollout whose step `step` failed.
fn failed(step: usize, steps: usize, error: &EnvError) -> ErrorReply {
    if matches!(error, EnvError::Backend(_)) {
        tracing::warn!(%error, step, "rollout failed");
    }
    if step == 0 {
        return convert::wire_error(error);
    }
    let message = format!("step {step} of {steps} failed, and the steps before it are lost: {error}");
    ErrorReply::new(ErrorCode::RolloutFailed, "", message)
        .with_hint("check the policy; the environments are in the state before the failed step")
}
