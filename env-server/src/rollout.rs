//! Rollouts: a policy is run next to the environments.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, Trajectory, VecEnv};
use twinstep_policy::{ActionSampler, BehaviourPolicy, Mlp, Normaliser};
use twinstep_protocol::{ErrorCode, ErrorReply, convert, message, tensor};

use crate::dispatch::shutting_down;
use crate::messages::{MAX_POLICY_BYTES, ServerState};

/// Maximum number of layers, and of units of a layer, of a policy.
const MAX_LAYERS: usize = 16;
const MAX_UNITS: u64 = 65_536;
/// Number of parameters up to which padding may be any share of a network.
const MIN_PADDED: usize = 1 << 16;
/// Limit of the logarithm of a standard deviation.
const MAX_LOG_STD: f32 = 20.0;
/// Maximum size of a trajectory without its ended episodes [bytes]. Zenoh refuses messages of more than 1 GiB.
const MAX_TRAJECTORY_BYTES: u64 = 1 << 29;

/// Time after which a rollout lets other requests execute. A step is not divided.
const SLICE: Duration = Duration::from_millis(20);

/// A policy with the memory that it takes of the server's budget.
pub struct HeldPolicy {
    policy: Arc<BehaviourPolicy>,
    state: Arc<ServerState>,
    bytes: usize,
}

impl Drop for HeldPolicy {
    fn drop(&mut self) {
        self.state.policy_bytes.fetch_sub(self.bytes, Ordering::AcqRel);
    }
}

/// A rollout in execution.
pub struct Rollout {
    sampler: ActionSampler<Arc<BehaviourPolicy>>,
    step: usize,
    steps: usize,
    /// The policy, if the request has sent it.
    pub policy: Option<HeldPolicy>,
}

impl Rollout {
    /// Begins to run the policy of `request`, or `held`, the last policy with its id. The steps are written to `trajectory`.
    pub fn start(
        request: &message::RolloutRequest<'_>,
        held: Option<&(u64, HeldPolicy)>,
        env: &dyn VecEnv,
        state: &Arc<ServerState>,
        trajectory: &mut Trajectory,
    ) -> Result<Self, ErrorReply> {
        let steps = check_steps(request.steps, env, state.max_rollout_steps)?;
        let new = request.policy.as_ref().map(|policy| read_policy(policy, env.spec(), state)).transpose()?;
        let policy = match &new {
            Some(new) => &new.policy,
            None => &held_policy(request.policy_id, held)?.policy,
        };
        trajectory.start(steps, env.spec(), env.obs(), env.critic_obs());
        let sampler = ActionSampler::new(Arc::clone(policy), request.noise_seed, env.num_envs());
        Ok(Self { sampler, step: 0, steps, policy: new })
    }

    /// Executes steps for [`SLICE`]. Returns true after the last one.
    ///
    /// An error after the first step is [`ErrorCode::RolloutFailed`].
    pub fn advance(
        &mut self,
        env: &mut dyn VecEnv,
        state: &ServerState,
        trajectory: &mut Trajectory,
    ) -> Result<bool, ErrorReply> {
        let start = Instant::now();
        while self.step < self.steps {
            if state.shutting_down.load(Ordering::Acquire) {
                return Err(shutting_down());
            }
            self.sampler.step(env, trajectory).map_err(|error| failed(self.step, self.steps, &error))?;
            state.env_steps.fetch_add(env.num_envs() as u64, Ordering::Relaxed);
            self.step += 1;
            if start.elapsed() >= SLICE {
                break;
            }
        }
        Ok(self.step == self.steps)
    }
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

fn held_policy(id: Option<u64>, held: Option<&(u64, HeldPolicy)>) -> Result<&HeldPolicy, ErrorReply> {
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
fn read_policy(
    policy: &message::RolloutPolicy<'_>,
    spec: &EnvSpec,
    state: &Arc<ServerState>,
) -> Result<HeldPolicy, ErrorReply> {
    let sizes = read_sizes(&policy.sizes, spec)?;
    let bytes = reserve(&sizes, state)?;
    // From here on, the reservation ends with the value.
    let held = |policy| HeldPolicy { policy: Arc::new(policy), state: Arc::clone(state), bytes };
    let decoded = decode_policy(policy, &sizes, spec);
    decoded.map(held).inspect_err(|_| {
        state.policy_bytes.fetch_sub(bytes, Ordering::AcqRel);
    })
}

/// Reserves the memory of a network: its parameters, and their arrangement for the forward pass, with padding. Returns the
/// size [bytes].
fn reserve(sizes: &[usize], state: &ServerState) -> Result<usize, ErrorReply> {
    let reject = |message: String, hint: &str| {
        Err(ErrorReply::new(ErrorCode::TooLarge, "policy.sizes", message).with_hint(hint))
    };
    let (sent, padded) = (Mlp::num_weights(sizes).unwrap_or(usize::MAX), Mlp::num_padded(sizes).unwrap_or(usize::MAX));
    if padded > (2 * sent).max(MIN_PADDED) {
        let message = format!("`policy.sizes` = {sizes:?} needs {padded} numbers in memory for {sent} that are sent");
        return reject(message, "use hidden layers of 16 or more units");
    }
    let bytes = 2 * size_of::<f32>() * padded;
    if state.policy_bytes.fetch_add(bytes, Ordering::AcqRel) + bytes > MAX_POLICY_BYTES {
        state.policy_bytes.fetch_sub(bytes, Ordering::AcqRel);
        let message = format!("the policies of all rollouts would need more than {MAX_POLICY_BYTES} bytes");
        return reject(message, "close leases that hold a policy, or send a smaller one");
    }
    Ok(bytes)
}

fn decode_policy(
    policy: &message::RolloutPolicy<'_>,
    sizes: &[usize],
    spec: &EnvSpec,
) -> Result<BehaviourPolicy, ErrorReply> {
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
    let expected = Mlp::num_weights(sizes).unwrap_or(usize::MAX);
    let weights = read_finite(policy.weights, "policy.weights", expected)?;
    let actor = Mlp::from_weights(sizes, &weights).expect("sizes and number of weights were checked");
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
