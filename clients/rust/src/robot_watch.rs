//! Looking at the robots of a server, without environments of one's own.

use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use twinstep_protocol::keys;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::connection::zenoh_error;
use crate::discovery::{choose_server, visible_servers};
use crate::{ClientError, ConnectOptions, session};

/// Time between two looks for the server while its scene is awaited.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// A connection that sees the robots of a server. It has no environments and cannot move anything.
pub struct RobotWatch {
    session: Session,
    sid: String,
    name: String,
    timeout: Duration,
}

/// Frames arrive until the value is dropped.
pub struct FrameSubscription {
    _subscriber: Subscriber<()>,
}

impl RobotWatch {
    /// Connects to the server at `options.endpoint`; `options.num_envs` is not used.
    pub fn open(options: &ConnectOptions) -> Result<Self, ClientError> {
        let session = session::open(options)?;
        let (sid, name) = choose_server(&session, options)?;
        Ok(Self { session, sid, name, timeout: options.connect_timeout })
    }

    /// Returns the name of the robot.
    pub fn robot(&self) -> &str {
        &self.name
    }

    /// Returns what stays the same in every frame, as JSON.
    pub fn scene(&self) -> Result<Vec<u8>, ClientError> {
        let (found, scenes) = channel();
        let _subscription = self.subscribe(keys::scene(&self.sid), move |scene| drop(found.send(scene.to_vec())))?;
        let since = Instant::now();
        loop {
            match scenes.recv_timeout(POLL_PERIOD) {
                Ok(scene) => return Ok(scene),
                Err(RecvTimeoutError::Timeout) if since.elapsed() < self.timeout => {}
                Err(_) => {
                    let waited_s = since.elapsed().as_secs_f64();
                    return Err(ClientError::NoScene { robot: self.name.clone(), waited_s });
                }
            }
        }
    }

    /// Calls `show` with every frame, on a thread of Zenoh. `show` must not wait.
    pub fn frames(&self, show: impl Fn(&[u8]) + Send + Sync + 'static) -> Result<FrameSubscription, ClientError> {
        self.subscribe(keys::frame(&self.sid), show)
    }

    /// Returns true if the server's liveliness token is visible.
    pub fn server_is_visible(&self) -> bool {
        visible_servers(&self.session).iter().any(|(sid, _)| *sid == self.sid)
    }

    fn subscribe(
        &self,
        key: String,
        show: impl Fn(&[u8]) + Send + Sync + 'static,
    ) -> Result<FrameSubscription, ClientError> {
        let subscriber = self.session.declare_subscriber(key);
        let subscriber = subscriber.callback(move |sample: Sample| show(&sample.payload().to_bytes()));
        let subscriber = subscriber.wait().map_err(|error| zenoh_error(&error))?;
        Ok(FrameSubscription { _subscriber: subscriber })
    }
}
