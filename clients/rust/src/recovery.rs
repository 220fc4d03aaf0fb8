//! Search for a new lease in place of a lost one.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Weak};
use std::time::Duration;

use rand::Rng;
use twinstep_model::{EnvError, stream};
use twinstep_protocol::ErrorCode;

use crate::remote_env::client_error;
use crate::{ClientError, ConnectOptions, RemoteVecEnv};

/// Time without a reply and without a visible server after which the server is lost.
pub const LOSS_TIMEOUT: Duration = Duration::from_secs(3);
/// Time after which it is checked whether the server is visible.
pub const CHECK_PERIOD: Duration = Duration::from_millis(500);
/// Pause before the next attempt to lease robots.
const RETRY_PERIOD: Duration = Duration::from_millis(200);

/// A thread that requests a lease until it is granted. It ends when this is dropped.
pub struct Recovery {
    granted: Receiver<RemoteVecEnv>,
    _needed: Arc<()>,
}

impl Recovery {
    /// Starts to request a lease at one of these servers, in order, in place of `lost`.
    pub fn start(servers: Vec<ConnectOptions>, lost: RemoteVecEnv) -> Result<Self, EnvError> {
        let (sender, granted) = channel();
        let needed = Arc::new(());
        let is_needed = Arc::downgrade(&needed);
        let thread = std::thread::Builder::new().name("lease".to_owned());
        thread
            .spawn(move || {
                // The old connection ends, so that its lease expires at a server that still runs.
                drop(lost);
                request_lease(&servers, &is_needed, &sender);
            })
            .map_err(|cause| EnvError::Remote(Box::new(cause)))?;
        Ok(Self { granted, _needed: needed })
    }

    /// Returns the new lease, if one has been granted since the loss.
    pub fn take(&self) -> Option<RemoteVecEnv> {
        self.granted.try_recv().ok()
    }
}

/// Requests a lease until it is granted or not needed any more.
fn request_lease(servers: &[ConnectOptions], is_needed: &Weak<()>, granted: &Sender<RemoteVecEnv>) {
    loop {
        for options in servers {
            if is_needed.strong_count() == 0 {
                return;
            }
            match RemoteVecEnv::connect(options) {
                Ok(env) => return drop(granted.send(env)),
                Err(error) => tracing::debug!(endpoint = options.endpoint, %error, "no lease yet"),
            }
        }
        std::thread::sleep(RETRY_PERIOD);
    }
}

/// Returns the seed of a robot's first episode after its server was lost for the n-th time.
pub fn recovery_seed(seed: u64, losses: u64) -> u64 {
    stream(seed, "lost server", losses).next_u64()
}

/// Returns true if the request timed out: it may have been executed, and its reply may still arrive.
pub fn is_timeout(error: &EnvError) -> bool {
    matches!(client_error(error), Some(ClientError::RequestTimeout { .. }))
}

/// Returns true if the error means that the lease does not exist any more, or that its server cannot be reached.
pub fn is_loss(error: &EnvError) -> bool {
    match client_error(error) {
        Some(ClientError::Restarted { .. } | ClientError::ShuttingDown { .. }) => true,
        Some(ClientError::Rejected(rejection)) => {
            matches!(rejection.code, ErrorCode::LeaseLost | ErrorCode::StaleEpoch)
        }
        _ => is_timeout(error),
    }
}
