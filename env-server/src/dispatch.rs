//! Puts each query into the mailbox that answers it. Runs on Zenoh's threads, so it neither computes nor sends.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::Instant;

use twinstep_protocol::convert::MAX_ROLLOUT_REQUEST_BYTES;
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, Secret, encode, message};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::executor::{Executor, Handled, Handler, Mailbox, SendLock, lock};
use crate::messages::{Reply, Request, RequestKind, ServerState};

/// Maximum size of a `hello` or `lease` request [bytes].
const MAX_CONTROL_BYTES: usize = 4 << 10;
/// Maximum size of a key [bytes]; those of the protocol have at most 120.
const MAX_KEY_BYTES: usize = 256;
/// Size of a payload up to which it is copied. A larger one keeps the buffer in which it arrived.
const MAX_COPIED_BYTES: usize = 32 << 10;
/// Size of the refusals that wait to be sent [bytes].
const MAX_REFUSALS_BYTES: usize = 64 << 10;

/// Leases by id.
pub type Routes = Arc<RwLock<HashMap<String, Arc<Route>>>>;

/// How to reach a lease.
pub struct Route {
    /// Secret of its client.
    pub secret: Secret,
    /// Maximum size of a request to its environments, except a rollout [bytes].
    pub max_request_bytes: usize,
    /// Requests to its environments.
    pub mailbox: Arc<Mailbox>,
    /// Time of the client's last request. Keeps the lease alive when the token is not visible.
    pub last_request: Mutex<Instant>,
}

/// Puts queries into mailboxes.
pub struct Dispatcher {
    /// Id of the server.
    pub sid: String,
    /// The leases.
    pub routes: Routes,
    /// Mailbox of `hello` requests.
    pub hello: Arc<Mailbox>,
    /// Mailbox of `lease` requests.
    pub lease: Arc<Mailbox>,
    /// Mailbox of requests that are refused, or executed already. The payloads of refused ones are dropped first.
    pub refusals: Arc<Mailbox>,
    /// State of the server.
    pub state: Arc<ServerState>,
    /// Stops the robot.
    pub factory: Arc<dyn EnvFactory>,
}

impl Dispatcher {
    /// Enqueues a query. Never blocks. A query that no client sends gets no reply.
    pub fn dispatch(&self, mut query: Query) {
        if query.key_expr().len() > MAX_KEY_BYTES || !query.parameters().as_str().is_empty() {
            return;
        }
        copy_out(&mut query);
        let (mailbox, kind) = match self.route(&query) {
            Ok(route) => route,
            Err(error) => return self.refuse(query, error),
        };
        if let Err(request) = mailbox.push(Request { query, kind }) {
            let error = ErrorReply::new(ErrorCode::Busy, "", "too many requests are queued already");
            self.refuse(request.query, error.with_hint("send one request at a time"));
        }
    }

    fn route(&self, query: &Query) -> Result<(Arc<Mailbox>, RequestKind), ErrorReply> {
        let request = keys::parse(query.key_expr().as_str(), &self.sid).ok_or_else(|| {
            let message = format!("the key `{}` does not exist", query.key_expr());
            let hint = "use hello, lease, stop, or env/<lease>/reset, step, rollout, close, render or samples";
            ErrorReply::new(ErrorCode::UnknownKey, "", message).with_hint(hint)
        })?;
        if let keys::Request::Env { lease, verb } = request {
            return self.route_env(query, lease, verb);
        }
        if request == keys::Request::Stop {
            return Ok((Arc::clone(&self.refusals), RequestKind::Answered(self.stop().into())));
        }
        if self.state.shutting_down.load(Ordering::Acquire) {
            return Err(shutting_down());
        }
        check_size(query, MAX_CONTROL_BYTES)?;
        Ok(match request {
            keys::Request::Hello => (Arc::clone(&self.hello), RequestKind::Hello),
            _ => (Arc::clone(&self.lease), RequestKind::Lease),
        })
    }

    /// Stops the robot before any other request is looked at.
    fn stop(&self) -> Result<Vec<u8>, ErrorReply> {
        if self.factory.stop() {
            return Ok(encode(&message::StopReply { protocol: PROTOCOL }));
        }
        let error = ErrorReply::new(ErrorCode::UnknownKey, "", "this server simulates: there is no robot to stop");
        Err(error.with_hint("end the lease with close"))
    }

    fn route_env(
        &self,
        query: &Query,
        lease: &str,
        verb: EnvMethod,
    ) -> Result<(Arc<Mailbox>, RequestKind), ErrorReply> {
        let secret = attached_secret(query);
        let routes = self.routes.read().unwrap_or_else(PoisonError::into_inner);
        let route = routes.get(lease).filter(|route| secret == Some(route.secret));
        let route = route.ok_or_else(|| no_such_lease(lease))?;
        check_size(query, self.max_request_bytes(route, verb)?)?;
        *lock(&route.last_request) = Instant::now();
        Ok((Arc::clone(&route.mailbox), RequestKind::Env(verb)))
    }

    /// Returns the maximum size of a request for `verb` [bytes]. Fails if the server does not have the verb.
    fn max_request_bytes(&self, route: &Route, verb: EnvMethod) -> Result<usize, ErrorReply> {
        if verb != EnvMethod::Rollout {
            return Ok(route.max_request_bytes);
        }
        if self.state.max_rollout_steps == 0 {
            let error = ErrorReply::new(ErrorCode::UnknownKey, "", "this server has no rollouts");
            return Err(error.with_hint("use step, or start the server with `--max-rollout-steps` above 0"));
        }
        Ok(MAX_ROLLOUT_REQUEST_BYTES)
    }

    fn refuse(&self, mut query: Query, error: ErrorReply) {
        if let Some(payload) = query.payload_mut() {
            *payload = ZBytes::new();
        }
        // A refusal that has no room is dropped: a client repeats its request.
        let _ = self.refusals.push(Request { query, kind: RequestKind::Answered(Reply::Err(error)) });
    }
}

/// Replaces payload and attachment by copies. As they arrive they are parts of a buffer, which they would keep.
///
/// An attachment that is no secret is dropped: it is not the right one.
fn copy_out(query: &mut Query) {
    if let Some(payload) = query.payload_mut().filter(|payload| payload.len() <= MAX_COPIED_BYTES) {
        *payload = ZBytes::from(payload.to_bytes().into_owned());
    }
    let secret = attached_secret(query);
    if let Some(attachment) = query.attachment_mut() {
        *attachment = secret.map_or_else(ZBytes::new, |secret| ZBytes::from(secret.as_bytes().to_vec()));
    }
}

/// Creates the mailbox of refused requests.
pub fn refusals(executor: &Executor, send_lock: SendLock) -> Arc<Mailbox> {
    Mailbox::new(executor, "", send_lock, MAX_REFUSALS_BYTES, Refusals)
}

struct Refusals;

impl Handler for Refusals {
    fn handle(&mut self, kind: &RequestKind, _query: &Query) -> Handled {
        match kind {
            RequestKind::Answered(reply) => Handled::Reply(reply.clone()),
            _ => Handled::Forwarded,
        }
    }
}

/// Returns the secret that is attached to a query.
pub fn attached_secret(query: &Query) -> Option<Secret> {
    Secret::from_bytes(&query.attachment()?.to_bytes())
}

fn check_size(query: &Query, limit: usize) -> Result<(), ErrorReply> {
    let bytes = query.payload().map_or(0, ZBytes::len);
    if bytes <= limit {
        return Ok(());
    }
    let message = format!("the request has {bytes} bytes; at most {limit} are accepted at this key");
    Err(ErrorReply::new(ErrorCode::TooLarge, "", message).with_hint("send arrays of `num_envs` rows"))
}

/// Returns the error reply to a request for a lease that does not exist or belongs to somebody else. It does not say
/// which.
pub fn no_such_lease(lease: &str) -> ErrorReply {
    let message = format!(
        "lease `{lease}` was closed, expired, or was never granted, or the attached secret is not that of its client"
    );
    ErrorReply::new(ErrorCode::LeaseLost, "lease", message).with_hint("request a new lease")
}

/// Returns the error reply to every new request while the server shuts down.
pub fn shutting_down() -> ErrorReply {
    ErrorReply::new(ErrorCode::ShuttingDown, "", "the server is shutting down; nothing was executed")
}
