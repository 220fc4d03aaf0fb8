//! Clients that harm others: one that uses a lease without its secret, and one that reads no replies.

use std::time::Duration;

use twinstep_client::{ClientError, ConnectOptions, Connection, RemoteVecEnv};
use twinstep_model::{AgentCommands, ResetRequest, VecEnv};
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::message::{CloseRequest, LeaseRequest, Reclaim};
use twinstep_protocol::{ErrorCode, PROTOCOL, Secret, convert, encode};

use crate::proxy::Proxy;

/// Requests that are sent without reading a reply. Their replies are more than the buffers of a connection hold.
const UNREAD_REQUESTS: usize = 6000;
/// Time for which nothing is read, longer than the server waits for a client that does not read.
const SILENCE: Duration = Duration::from_secs(3);

/// Uses and reclaims a lease with all that is visible of it: its id, its epoch, and the next sequence number.
///
/// Fails unless every request is refused in the same way.
pub fn use_foreign_lease(endpoint: &str, lease: &str, epoch: u64, last_seq: u64) -> Result<(), String> {
    let connection = Connection::open(&ConnectOptions::new(endpoint, 1), Secret::random()).map_err(text)?;
    let refused = |key: String, request: Vec<u8>| match connection.request(&key, request) {
        Err(ClientError::Rejected(error)) if error.code == ErrorCode::LeaseLost => Ok(()),
        other => Err(format!("a request without the secret at {key}: {other:?}")),
    };
    let key = |method| keys::env(connection.sid(), lease, method);
    for seq in [last_seq, last_seq + 1] {
        refused(
            key(EnvMethod::Step),
            convert::encode_actions(&[0.9; 24], &AgentCommands::default(), None, epoch, seq),
        )?;
        refused(key(EnvMethod::Reset), convert::encode_reset(&ResetRequest::default(), epoch, seq))?;
        refused(key(EnvMethod::Close), encode(&CloseRequest { protocol: PROTOCOL, epoch, seq }))?;
    }
    let reclaim = LeaseRequest {
        protocol: PROTOCOL,
        client: connection.client().to_owned(),
        num_envs: 2,
        autoreset: twinstep_model::AutoresetMode::NextStep,
        max_episode_steps: None,
        critic: false,
        spec_hash: None,
        reclaim: Some(Reclaim { lease: lease.to_owned(), epoch }),
    };
    refused(keys::lease(connection.sid()), encode(&reclaim))
}

/// Connects, then sends requests and reads no reply until the server closes the link.
pub fn read_nothing(endpoint: &str) -> Result<(), String> {
    let proxy = Proxy::start(endpoint)?;
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&proxy.endpoint, 1)).map_err(text)?;
    env.reset(&ResetRequest::default()).map_err(text)?;
    let connection = Connection::open(&ConnectOptions::new(&proxy.endpoint, 1), Secret::random()).map_err(text)?;
    let unknown = format!("twinstep/{}/{}", connection.sid(), "x".repeat(1000));
    proxy.hold_replies(SILENCE);
    env.send(&[0.5; 12]).map_err(text)?;
    let unread: Result<Vec<_>, _> = (0..UNREAD_REQUESTS).map(|_| connection.send(&unknown, Vec::new())).collect();
    // The link may be closed already.
    drop(unread);
    std::thread::sleep(SILENCE);
    // Both clients notice the end of their links at once.
    proxy.cut();
    Ok(())
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}
