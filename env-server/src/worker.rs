//! Worker of one lease: owns its environments and executes every request exactly once, in order.
//!
//! Requests carry the lease's epoch and a sequence number. The worker executes the next number and caches the reply.
//! A repeated request gets the cached reply. Any other number, or the same number with another request, is an error. A
//! request that is rejected without effect does not consume its number. `render` and `samples` only read: they have no
//! number and are answered between two requests.

use std::hash::{BuildHasher, RandomState};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use twinstep_model::{AgentCommands, BackendError, EnvError, Trajectory, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, convert, decode, encode, message, tensor};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::dispatch::shutting_down;
use crate::executor::{Handled, Handler, panic_text};
use crate::messages::{LeaseParams, Reply, RequestKind, ServerState};
use crate::rollout::{HeldPolicy, Rollout};

/// Releases the lease of a worker, for the given reason.
pub type Release = Box<dyn Fn(&str) + Send>;

/// The environments of one lease.
pub struct Worker {
    params: LeaseParams,
    factory: Arc<dyn EnvFactory>,
    state: Arc<ServerState>,
    release: Release,
    /// `None` until the first request.
    env: Option<Box<dyn VecEnv>>,
    epoch: u64,
    last_seq: u64,
    /// Method and reply of `last_seq`.
    last_reply: Option<(EnvMethod, Reply)>,
    /// Hash of the request of `last_seq`; `None` if another process has reclaimed the lease since.
    last_request: Option<u64>,
    /// Hashes requests, with random keys.
    hasher: RandomState,
    actions: Vec<f32>,
    /// Policy of the last rollout that sent one, with its sequence number.
    policy: Option<(u64, HeldPolicy)>,
    /// Rollout in execution; its request is the first in the mailbox.
    rollout: Option<Rollout>,
    trajectory: Trajectory,
    /// Reason why the environments cannot be used any more; `None` while they can.
    failure: Option<String>,
}

impl Handler for Worker {
    fn handle(&mut self, kind: &RequestKind, query: &Query) -> Handled {
        self.build();
        match kind {
            RequestKind::Env(verb) => self.answer(*verb, query).map_or(Handled::Unfinished, Handled::Reply),
            RequestKind::Granted { epoch } => Handled::Reply(self.transfer(*epoch)),
            RequestKind::Hello | RequestKind::Lease | RequestKind::Answered(_) => Handled::Forwarded,
        }
    }
}

impl Worker {
    /// Creates a worker whose environments are built by its first request.
    pub fn new(params: LeaseParams, factory: Arc<dyn EnvFactory>, state: Arc<ServerState>, release: Release) -> Self {
        Self {
            params,
            factory,
            state,
            release,
            env: None,
            epoch: 1,
            last_seq: 0,
            last_reply: None,
            last_request: None,
            hasher: RandomState::new(),
            actions: Vec::new(),
            policy: None,
            rollout: None,
            trajectory: Trajectory::default(),
            failure: None,
        }
    }

    /// Builds the environments unless they are built or could not be built.
    fn build(&mut self) {
        if self.env.is_some() || self.failure.is_some() {
            return;
        }
        let LeaseParams { lease, num_envs, autoreset, max_episode_steps, .. } = &self.params;
        let built = catch_unwind(AssertUnwindSafe(|| {
            self.factory.build(*num_envs, *autoreset, *max_episode_steps).map_err(|error| error.to_string())
        }));
        match built.unwrap_or_else(|panic| Err(panic_text(&panic))) {
            Ok(env) => self.env = Some(env),
            Err(reason) => {
                tracing::error!(lease, reason, "environments could not be built");
                self.failure = Some(format!("they could not be built: {reason}"));
            }
        }
    }

    fn transfer(&mut self, epoch: u64) -> Reply {
        if epoch != self.epoch {
            // The new owner may repeat the last request without knowing what it contained.
            (self.epoch, self.last_request) = (epoch, None);
        }
        if let Some(reason) = &self.failure {
            // The lease is unusable: release its environments for another lease.
            let lost = lost_environments(reason);
            (self.release)("its environments failed");
            return Reply::Err(lost);
        }
        let mut spec = self.env().spec().clone();
        if !self.params.critic {
            spec.critic_observation.clear();
        }
        Reply::Ok(ZBytes::from(encode(&message::LeaseReply {
            protocol: PROTOCOL,
            lease: self.params.lease.clone(),
            epoch: self.epoch,
            num_envs: self.params.num_envs as u64,
            autoreset: self.params.autoreset,
            last_seq: self.last_seq,
            spec,
        })))
    }

    /// Returns the environments, which exist unless there is a `failure`.
    fn env(&mut self) -> &mut dyn VecEnv {
        self.env.as_deref_mut().expect("a worker without environments has a failure")
    }

    /// Returns the reply to a request, or `None` if it is not executed completely.
    fn answer(&mut self, verb: EnvMethod, query: &Query) -> Option<Reply> {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        if self.rollout.is_none()
            && let Some(reply) = self.answer_without_executing(verb, &payload)
        {
            return Some(reply);
        }
        let seq = self.last_seq + 1;
        let outcome = catch_unwind(AssertUnwindSafe(|| self.execute(verb, &payload)));
        let answer = match outcome {
            Ok(Ok(Some(bytes))) => Reply::Ok(ZBytes::from(bytes)),
            Ok(Ok(None)) => return None,
            // Rejected without effect: the number is not consumed.
            Ok(Err(error)) if !error.code.consumes_seq() => {
                self.rollout = None;
                return Some(Reply::Err(error));
            }
            Ok(Err(error)) => Reply::Err(error),
            Err(panic) => {
                let reason = panic_text(&panic);
                tracing::error!(lease = self.params.lease, reason, "environments panicked");
                self.failure = Some(reason.clone());
                Reply::Err(lost_environments(&reason))
            }
        };
        self.rollout = None;
        self.last_seq = seq;
        self.last_reply = Some((verb, answer.clone()));
        self.last_request = Some(self.hasher.hash_one(&*payload));
        Some(answer)
    }

    /// Answers a request that only reads, is refused or repeated. Returns `None` for one that has to be executed.
    fn answer_without_executing(&mut self, verb: EnvMethod, payload: &[u8]) -> Option<Reply> {
        if verb == EnvMethod::Render {
            return Some(self.render(payload).into());
        }
        if verb == EnvMethod::Samples {
            return Some(self.samples(payload).into());
        }
        let header = match decode::<message::RequestHeader>(payload) {
            Ok(header) => header,
            Err(error) => return Some(Reply::Err(error)),
        };
        if let Err(error) = self.check_header(&header) {
            return Some(Reply::Err(error));
        }
        if header.seq == self.last_seq {
            let is_repeat = self.last_request.is_none_or(|last| last == self.hasher.hash_one(payload));
            return Some(match &self.last_reply {
                Some((answered, answer)) if *answered == verb && is_repeat => answer.clone(),
                _ => Reply::Err(stale_sequence(header.seq, self.last_seq)),
            });
        }
        if self.state.shutting_down.load(Ordering::Acquire) {
            return Some(Reply::Err(shutting_down()));
        }
        let failure = self.failure.as_ref().filter(|_| verb != EnvMethod::Close);
        failure.map(|reason| Reply::Err(lost_environments(reason)))
    }

    fn check_header(&self, header: &message::RequestHeader) -> Result<(), ErrorReply> {
        self.check_owner(header.protocol, header.epoch)?;
        if header.seq < self.last_seq {
            return Err(stale_sequence(header.seq, self.last_seq));
        }
        if header.seq > self.last_seq + 1 {
            let message = format!("`seq` = {} skips a number: the last consumed is {}", header.seq, self.last_seq);
            return Err(ErrorReply::new(ErrorCode::SequenceGap, "seq", message)
                .with_hint("increase `seq` by one per request, and repeat a request until a reply arrives"));
        }
        Ok(())
    }

    fn check_owner(&self, protocol: u16, epoch: u64) -> Result<(), ErrorReply> {
        if protocol != PROTOCOL {
            return Err(ErrorReply::version(protocol));
        }
        if epoch != self.epoch {
            return Err(stale_epoch("epoch", epoch, self.epoch));
        }
        Ok(())
    }

    /// Checks a request without a sequence number. Returns the index of its environment.
    fn check_reading(&self, protocol: u16, epoch: u64, env: u64) -> Result<usize, ErrorReply> {
        self.check_owner(protocol, epoch)?;
        if self.state.shutting_down.load(Ordering::Acquire) {
            return Err(shutting_down());
        }
        if let Some(reason) = &self.failure {
            return Err(lost_environments(reason));
        }
        Ok(usize::try_from(env).unwrap_or(usize::MAX))
    }

    fn samples(&mut self, payload: &[u8]) -> Result<Vec<u8>, ErrorReply> {
        let message::SamplesRequest { protocol, epoch, env } = decode(payload)?;
        let env = self.check_reading(protocol, epoch, env)?;
        let samples = self.env().samples(env).map_err(|error| convert::wire_error(&error))?;
        Ok(convert::encode_samples(&samples))
    }

    fn render(&mut self, payload: &[u8]) -> Result<Vec<u8>, ErrorReply> {
        let message::RenderRequest { protocol, epoch, env } = decode(payload)?;
        let env = self.check_reading(protocol, epoch, env)?;
        // `scene` does not change the environments, so they stay usable after a panic.
        let scene = catch_unwind(AssertUnwindSafe(|| self.env().scene(env)))
            .map_err(|panic| ErrorReply::new(ErrorCode::Internal, "", panic_text(&panic)))?;
        scene.map(convert::encode_scene).map_err(|error| convert::wire_error(&error))
    }

    /// Executes a request, or a slice of it. Returns `None` if more is left.
    fn execute(&mut self, verb: EnvMethod, payload: &[u8]) -> Result<Option<Vec<u8>>, ErrorReply> {
        if verb == EnvMethod::Rollout {
            self.advance_rollout(payload)
        } else {
            self.execute_at_once(verb, payload).map(Some)
        }
    }

    fn advance_rollout(&mut self, payload: &[u8]) -> Result<Option<Vec<u8>>, ErrorReply> {
        let Self { env, policy, rollout, trajectory, state, params, last_seq, .. } = self;
        let env = env.as_deref_mut().expect("a worker without environments has a failure");
        if rollout.is_none() {
            *rollout = Some(Rollout::start(&decode(payload)?, policy.as_ref(), env, state, trajectory)?);
        }
        let running = rollout.as_mut().expect("it was started");
        if !running.advance(env, state, trajectory)? {
            return Ok(None);
        }
        let seq = *last_seq + 1;
        if let Some(new) = running.policy.take() {
            *policy = Some((seq, new));
        }
        Ok(Some(convert::encode_trajectory(trajectory, seq, params.critic)))
    }

    fn execute_at_once(&mut self, verb: EnvMethod, payload: &[u8]) -> Result<Vec<u8>, ErrorReply> {
        match verb {
            EnvMethod::Reset => {
                let request: message::ResetRequest<'_> = decode(payload)?;
                let critic = self.params.critic;
                let env = self.env();
                let reset = convert::read_reset(&request, env.num_envs())?;
                let obs = env.reset(&reset).map_err(|error| convert::wire_error(&error))?.to_vec();
                let critic_obs = if critic { env.critic_obs() } else { &[] };
                Ok(convert::encode_observations(&obs, critic_obs, env.real_time(), request.seq))
            }
            EnvMethod::Step => {
                let request: message::StepRequest<'_> = decode(payload)?;
                let env = self.env.as_deref_mut().expect("a worker without environments has a failure");
                read_actions(request.actions, env.num_envs() * env.spec().action_len(), &mut self.actions)?;
                let commands = convert::read_commands(&request, env.num_envs())?;
                set_commands(env, commands).map_err(|error| convert::wire_error(&error))?;
                if let Some(tick) = request.for_tick {
                    env.set_action_tick(tick);
                }
                let batch = env.step(&self.actions).map_err(|error| logged(&error))?;
                self.state.env_steps.fetch_add(batch.reward.len() as u64, Ordering::Relaxed);
                Ok(convert::encode_step(batch, request.seq, self.params.critic))
            }
            EnvMethod::Close => {
                let request: message::CloseRequest = decode(payload)?;
                self.failure = Some("the client closed the lease".to_owned());
                (self.release)("closed by its client");
                Ok(encode(&message::CloseReply { protocol: PROTOCOL, seq: request.seq }))
            }
            EnvMethod::Render => self.render(payload),
            EnvMethod::Samples => self.samples(payload),
            EnvMethod::Rollout => unreachable!("a rollout is executed in slices"),
        }
    }
}

/// Sets the commands of a step request.
fn set_commands(env: &mut dyn VecEnv, commands: AgentCommands) -> Result<(), EnvError> {
    if let Some(velocity) = commands.velocity {
        env.set_velocity_commands(&velocity)?;
    }
    if let Some(gait) = commands.gait {
        env.set_gait_commands(&gait)?;
    }
    Ok(())
}

/// Decodes `expected` actions into `actions`.
///
/// The length is checked first, because `actions` would keep the capacity of an oversized message.
fn read_actions(bytes: &[u8], expected: usize, actions: &mut Vec<f32>) -> Result<(), ErrorReply> {
    convert::check_length("actions", bytes.len() / size_of::<f32>(), expected)?;
    tensor::read_into(bytes, actions, "actions")
}

fn logged(error: &EnvError) -> ErrorReply {
    let is_failure = |error: &BackendError| !matches!(error, BackendError::Waiting { .. });
    if matches!(error, EnvError::Backend(backend) if is_failure(backend)) {
        tracing::warn!(%error, "step failed");
    }
    convert::wire_error(error)
}

fn lost_environments(reason: &str) -> ErrorReply {
    ErrorReply::new(ErrorCode::LeaseLost, "lease", format!("the environments of this lease are lost: {reason}"))
        .with_hint("request a new lease")
}

/// Returns the error reply to a request whose epoch differs from that of the lease.
pub fn stale_epoch(field: &'static str, given: u64, current: u64) -> ErrorReply {
    let message = format!("`{field}` = {given} is not the epoch of this lease, {current}");
    ErrorReply::new(ErrorCode::StaleEpoch, field, message)
        .with_hint("another client has reclaimed the lease; request a new lease")
}

fn stale_sequence(given: u64, last: u64) -> ErrorReply {
    let message = format!("`seq` = {given} was answered before: the last consumed is {last}");
    ErrorReply::new(ErrorCode::StaleSequence, "seq", message)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oversized_actions_are_rejected_without_allocating() {
        let mut actions = Vec::new();
        let error = read_actions(&vec![0; 1 << 20], 12, &mut actions).expect_err("too many");
        assert_eq!(error.code, ErrorCode::BadShape);
        assert_eq!(actions.capacity(), 0);
        read_actions(&[0; 48], 12, &mut actions).expect("twelve");
        assert_eq!(actions, [0.0; 12]);
    }
}
