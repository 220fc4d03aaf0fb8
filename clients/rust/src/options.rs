//! Options of a connection.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use twinstep_model::AutoresetMode;

/// Server to connect to, and the environments to request.
#[derive(Clone, Debug)]
pub struct ConnectOptions {
    /// Zenoh endpoint of the server or of a router, such as `tcp/127.0.0.1:7447`.
    pub endpoint: String,
    /// Name of the robot. Required if several are visible. Among several servers of the same robot and task the one
    /// with the most free environments is chosen.
    pub robot: Option<String>,
    /// Id of the server, from [`crate::Discovery`]. Default: any.
    pub server_id: Option<String>,
    /// Number of environments.
    pub num_envs: usize,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: the server's.
    pub max_episode_steps: Option<u32>,
    /// Requests the privileged observations of group `critic`, for an asymmetric critic. A real robot has none.
    pub critic: bool,
    /// Spec hash that was stored with a policy; a server with a different one is rejected. Default: accept any.
    pub spec_hash: Option<String>,
    /// Zenoh configuration file (JSON5) for TLS, user and password.
    pub zenoh: Option<PathBuf>,
    /// Sends large messages through shared memory if client and server run on one machine.
    pub shared_memory: bool,
    /// Time after which connecting fails.
    pub connect_timeout: Duration,
    /// Time after which an unanswered request fails.
    pub timeout: Duration,
    /// Set to true by the user's program to end the wait for a robot that is not ready, such as by a signal handler.
    pub interrupted: Arc<AtomicBool>,
}

impl ConnectOptions {
    /// Creates options for `num_envs` environments of the only server at `endpoint`, with default timeouts.
    pub fn new(endpoint: impl Into<String>, num_envs: usize) -> Self {
        Self {
            endpoint: endpoint.into(),
            robot: None,
            server_id: None,
            num_envs,
            autoreset: AutoresetMode::NextStep,
            max_episode_steps: None,
            critic: false,
            spec_hash: None,
            zenoh: None,
            shared_memory: false,
            connect_timeout: Duration::from_secs(5),
            timeout: Duration::from_secs(20),
            interrupted: Arc::default(),
        }
    }
}
