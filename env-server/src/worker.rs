//! Worker of one lease: owns its environments and executes every request exactly once, in order.
//!
//! Requests carry the lease's epoch and a sequence number. The worker executes the next number and caches the reply.
//! A repeated request gets the cached reply. Any other number, or the same number with another request, is an error. A request that is rejected without effect
//! does not consume its number. `render` only reads: it has no number and is answered between two requests.

use std::hash::{BuildHasher, RandomState};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, SyncSender};

use twinstep_model::{EnvError, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, convert, decode, encode, message, tensor};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::messages::{LeaseManagerMessage, LeaseParams, ServerState, WorkerRequest};

/// Owns the environments of one lease.
pub struct Worker {
    grant: LeaseParams,
    env: Box<dyn VecEnv>,
    shared: Arc<ServerState>,
    lease_queue: SyncSender<LeaseManagerMessage>,
    epoch: u64,
    last_seq: u64,
    /// Method and reply of `last_seq`.
    last_reply: Option<(EnvMethod, CachedReply)>,
    /// Hash of the request of `last_seq`; `None` if another process has reclaimed the lease since.
    last_request: Option<u64>,
    /// Hashes requests, with random keys.
    hasher: RandomState,
    actions: Vec<f32>,
    /// Reason why the environments cannot be used any more; `None` while they can.
    failure: Option<String>,
}

/// An encoded reply, cached for repeated requests. Cloning shares the bytes.
#[derive(Clone)]
enum CachedReply {
    Ok(ZBytes),
    Err(ErrorReply),
}

impl Worker {
    /// Builds the environments and handles requests until the lease is released. Runs on a thread of its own.
    pub fn run(
        grant: LeaseParams,
        factory: &dyn EnvFactory,
        shared: Arc<ServerState>,
        lease_queue: SyncSender<LeaseManagerMessage>,
        jobs: &Receiver<WorkerRequest>,
    ) {
        let built = catch_unwind(AssertUnwindSafe(|| {
            factory.build(grant.num_envs, grant.autoreset, grant.max_episode_steps).map_err(|error| error.to_string())
        }));
        let env = match built.unwrap_or_else(|panic| Err(panic_text(&panic))) {
            Ok(env) => env,
            Err(reason) => return reject_all(jobs, &lease_queue, &grant.lease, &reason),
        };
        let mut worker = Self {
            env,
            shared,
            lease_queue,
            epoch: 1,
            last_seq: 0,
            last_reply: None,
            last_request: None,
            hasher: RandomState::new(),
            actions: Vec::new(),
            failure: None,
            grant,
        };
        // The loop ends when the lease manager removes the lease and so drops the sender.
        while let Ok(job) = jobs.recv() {
            match job {
                WorkerRequest::Env(verb, query) => {
                    let answer = worker.answer(verb, &query);
                    send(&query, answer);
                }
                WorkerRequest::Lease { query, epoch } => {
                    let answer = worker.transfer(epoch);
                    send(&query, answer);
                }
            }
        }
    }

    fn transfer(&mut self, epoch: u64) -> CachedReply {
        if epoch != self.epoch {
            // The new owner may repeat the last request without knowing what it contained.
            (self.epoch, self.last_request) = (epoch, None);
        }
        if let Some(reason) = &self.failure {
            // The lease is unusable: release its environments for another lease.
            self.request_release();
            return CachedReply::Err(lost_environments(reason));
        }
        let mut spec = self.env.spec().clone();
        if !self.grant.critic {
            spec.critic_observation.clear();
        }
        CachedReply::Ok(ZBytes::from(encode(&message::LeaseReply {
            protocol: PROTOCOL,
            lease: self.grant.lease.clone(),
            epoch: self.epoch,
            num_envs: self.grant.num_envs as u64,
            autoreset: self.grant.autoreset,
            last_seq: self.last_seq,
            spec,
        })))
    }

    /// Requests the release of the lease. If the queue is full, the lease is released later: at the next lease request
    /// or when it expires.
    fn request_release(&self) {
        let _ = self.lease_queue.try_send(LeaseManagerMessage::Closed(self.grant.lease.clone()));
    }

    fn answer(&mut self, verb: EnvMethod, query: &Query) -> CachedReply {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        if verb == EnvMethod::Render {
            return self.render(&payload).map_or_else(CachedReply::Err, |bytes| CachedReply::Ok(ZBytes::from(bytes)));
        }
        let header = match decode::<message::RequestHeader>(&payload) {
            Ok(header) => header,
            Err(error) => return CachedReply::Err(error),
        };
        if let Err(error) = self.check_header(&header) {
            return CachedReply::Err(error);
        }
        if header.seq == self.last_seq {
            let is_repeat = self.last_request.is_none_or(|last| last == self.hasher.hash_one(&*payload));
            return match &self.last_reply {
                Some((answered, answer)) if *answered == verb && is_repeat => answer.clone(),
                _ => CachedReply::Err(stale_sequence(header.seq, self.last_seq)),
            };
        }
        if self.shared.shutting_down.load(Ordering::Acquire) {
            return CachedReply::Err(shutting_down());
        }
        if let Some(reason) = self.failure.as_ref().filter(|_| verb != EnvMethod::Close) {
            return CachedReply::Err(lost_environments(reason));
        }
        let outcome = catch_unwind(AssertUnwindSafe(|| self.execute(verb, &payload)));
        let answer = match outcome {
            Ok(Ok(bytes)) => CachedReply::Ok(ZBytes::from(bytes)),
            // Rejected without effect: the number is not consumed.
            Ok(Err(error)) if !error.code.consumes_seq() => return CachedReply::Err(error),
            Ok(Err(error)) => CachedReply::Err(error),
            Err(panic) => {
                let reason = panic_text(&panic);
                tracing::error!(lease = self.grant.lease, reason, "environments panicked");
                self.failure = Some(reason.clone());
                CachedReply::Err(lost_environments(&reason))
            }
        };
        self.last_seq = header.seq;
        self.last_reply = Some((verb, answer.clone()));
        self.last_request = Some(self.hasher.hash_one(&*payload));
        answer
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

    fn render(&self, payload: &[u8]) -> Result<Vec<u8>, ErrorReply> {
        let request: message::RenderRequest = decode(payload)?;
        self.check_owner(request.protocol, request.epoch)?;
        if self.shared.shutting_down.load(Ordering::Acquire) {
            return Err(shutting_down());
        }
        if let Some(reason) = &self.failure {
            return Err(lost_environments(reason));
        }
        let env = usize::try_from(request.env).unwrap_or(usize::MAX);
        // `scene` does not change the environments, so they stay usable after a panic.
        let scene = catch_unwind(AssertUnwindSafe(|| self.env.scene(env)))
            .map_err(|panic| ErrorReply::new(ErrorCode::Internal, "", panic_text(&panic)))?;
        scene.map(convert::encode_scene).map_err(|error| convert::wire_error(&error))
    }

    fn execute(&mut self, verb: EnvMethod, payload: &[u8]) -> Result<Vec<u8>, ErrorReply> {
        match verb {
            EnvMethod::Reset => {
                let request: message::ResetRequest<'_> = decode(payload)?;
                let reset = convert::read_reset(&request)?;
                let obs = self.env.reset(&reset).map_err(|error| convert::wire_error(&error))?.to_vec();
                let critic_obs = if self.grant.critic { self.env.critic_obs() } else { &[] };
                Ok(convert::encode_observations(&obs, critic_obs, request.seq))
            }
            EnvMethod::Step => {
                let request: message::StepRequest<'_> = decode(payload)?;
                let expected = self.env.num_envs() * self.env.spec().action_len();
                read_actions(request.actions, expected, &mut self.actions)?;
                let batch = self.env.step(&self.actions).map_err(|error| logged(&error))?;
                self.shared.env_steps.fetch_add(batch.reward.len() as u64, Ordering::Relaxed);
                Ok(convert::encode_step(batch, request.seq, self.grant.critic))
            }
            EnvMethod::Close => {
                let request: message::CloseRequest = decode(payload)?;
                self.failure = Some("the client closed the lease".to_owned());
                self.request_release();
                Ok(encode(&message::CloseReply { protocol: PROTOCOL, seq: request.seq }))
            }
            EnvMethod::Render => self.render(payload),
        }
    }
}

/// Decodes `expected` actions into `actions`.
///
/// The length is checked first, because `actions` would keep the capacity of an oversized message.
fn read_actions(bytes: &[u8], expected: usize, actions: &mut Vec<f32>) -> Result<(), ErrorReply> {
    convert::check_length("actions", bytes.len() / size_of::<f32>(), expected)?;
    tensor::read_into(bytes, actions, "actions")
}

fn logged(error: &EnvError) -> ErrorReply {
    if matches!(error, EnvError::Backend(_)) {
        tracing::warn!(%error, "step failed");
    }
    convert::wire_error(error)
}

/// Answers every request with the reason why the environments could not be built, until the lease is released.
fn reject_all(
    jobs: &Receiver<WorkerRequest>,
    lease_queue: &SyncSender<LeaseManagerMessage>,
    lease: &str,
    reason: &str,
) {
    tracing::error!(lease, reason, "environments could not be built");
    let _ = lease_queue.try_send(LeaseManagerMessage::Closed(lease.to_owned()));
    while let Ok(job) = jobs.recv() {
        let (WorkerRequest::Env(_, query) | WorkerRequest::Lease { query, .. }) = job;
        let message = format!("the environments could not be built: {reason}");
        send(&query, CachedReply::Err(ErrorReply::new(ErrorCode::Internal, "", message)));
    }
}

fn send(query: &Query, answer: CachedReply) {
    match answer {
        CachedReply::Ok(bytes) => reply(query, bytes),
        CachedReply::Err(error) => reply_error(query, &error),
    }
}

/// Sends a reply. Failures are only logged, because the client may have disconnected.
pub fn reply(query: &Query, bytes: ZBytes) {
    if let Err(error) = query.reply(query.key_expr(), bytes).express(true).wait() {
        tracing::debug!(%error, key = %query.key_expr(), "reply not sent");
    }
}

/// Sends an error reply. Failures are only logged, because the client may have disconnected.
pub fn reply_error(query: &Query, error: &ErrorReply) {
    if let Err(failure) = query.reply_err(encode(error)).wait() {
        tracing::debug!(%failure, key = %query.key_expr(), "error reply not sent");
    }
}

fn panic_text(panic: &Box<dyn std::any::Any + Send>) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panicked".to_owned())
}

fn lost_environments(reason: &str) -> ErrorReply {
    ErrorReply::new(ErrorCode::LeaseLost, "lease", format!("the environments of this lease are lost: {reason}"))
        .with_hint("request a new lease")
}

/// Returns the error reply to every new request while the server shuts down.
pub fn shutting_down() -> ErrorReply {
    ErrorReply::new(ErrorCode::ShuttingDown, "", "the server is shutting down; nothing was executed")
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
