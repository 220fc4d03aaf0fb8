//! Messages between the threads of the server, and the state that they share.

use std::sync::atomic::{AtomicBool, AtomicU64};

use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::EnvMethod;
use zenoh::query::Query;

/// Message to the lease manager.
pub enum LeaseManagerMessage {
    /// A query that no worker handles.
    Query(Query),
    /// The liveliness token of a client appeared (`true`) or disappeared (`false`).
    Client(String, bool),
    /// A worker requests the release of its lease.
    Closed(String),
    /// Stop; return after the workers have terminated.
    Stop,
}

/// Request to a worker.
pub enum WorkerRequest {
    /// A query at one of the lease's keys.
    Env(EnvMethod, Query),
    /// A request for the lease itself.
    Lease {
        /// The query to answer.
        query: Query,
        /// Epoch of the lease from this request on; increased if the lease is reclaimed.
        epoch: u64,
    },
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

/// State that the workers share with the server.
pub struct ServerState {
    /// True once the server shuts down; no new request is executed.
    pub shutting_down: AtomicBool,
    /// Environment steps executed by all workers.
    pub env_steps: AtomicU64,
}
