//! Requests and replies inside the server, and the state that its threads share.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};

use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::{ErrorReply, encode};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

/// Zenoh's encoding of replies.
const ENCODING: &str = "application/msgpack";

/// A query and what to do with it.
pub struct Request {
    /// The query to answer.
    pub query: Query,
    /// What it requests.
    pub kind: RequestKind,
}

/// Size that counts for a request besides its payload [bytes].
const REQUEST_BYTES: usize = 512;

impl Request {
    /// Returns the size that counts while the request waits [bytes].
    pub fn bytes(&self) -> usize {
        REQUEST_BYTES + self.query.payload().map_or(0, ZBytes::len) + self.query.key_expr().len()
    }
}

/// What a query requests.
pub enum RequestKind {
    /// Identity of the server.
    Hello,
    /// A lease.
    Lease,
    /// A method of the environments of a lease.
    Env(EnvMethod),
    /// The reply to a lease request, from the lease itself.
    Granted {
        /// Epoch of the lease from this request on; increased if the lease is reclaimed.
        epoch: u64,
    },
    /// Nothing more: the request was refused or executed already, and the reply waits to be sent.
    Answered(Reply),
}

/// An encoded reply. Cloning shares the bytes.
#[derive(Clone)]
pub enum Reply {
    /// The message that was requested.
    Ok(ZBytes),
    /// An error.
    Err(ErrorReply),
}

impl Reply {
    /// Sends the reply. Failures are only logged, because the client may have disconnected. May block while the client
    /// does not read.
    pub fn send(&self, query: &Query) {
        let sent = match self {
            Self::Ok(bytes) => query.reply(query.key_expr(), bytes.clone()).encoding(ENCODING).express(true).wait(),
            Self::Err(error) => query.reply_err(encode(error)).encoding(ENCODING).wait(),
        };
        if let Err(error) = sent {
            tracing::debug!(%error, key = %query.key_expr(), "reply not sent");
        }
    }
}

impl From<Result<Vec<u8>, ErrorReply>> for Reply {
    fn from(result: Result<Vec<u8>, ErrorReply>) -> Self {
        result.map_or_else(Reply::Err, |bytes| Reply::Ok(ZBytes::from(bytes)))
    }
}

/// Parameters of a granted lease.
pub struct LeaseParams {
    /// Id of the lease.
    pub lease: String,
    /// Number of environments.
    pub num_envs: usize,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: that of the task.
    pub max_episode_steps: Option<u32>,
    /// True if the client receives the observations of group `critic`.
    pub critic: bool,
}

/// State that the leases share with the server.
#[derive(Default)]
pub struct ServerState {
    /// True once the server shuts down; no new request is executed.
    pub shutting_down: AtomicBool,
    /// Environment steps executed by all leases.
    pub env_steps: AtomicU64,
    /// Maximum number of steps of a rollout; 0 for a server without rollouts.
    pub max_rollout_steps: usize,
    /// Memory of the policies that the leases hold [bytes].
    pub policy_bytes: AtomicUsize,
}

/// Memory for the policies of all leases [bytes].
pub const MAX_POLICY_BYTES: usize = 256 << 20;
