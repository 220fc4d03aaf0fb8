//! Connection to one server: requests with retries, reasons of timeouts.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, Secret, decode, encode, keys, message, random_id};
use zenoh::bytes::ZBytes;
use zenoh::handlers::FifoChannelHandler;
use zenoh::key_expr::KeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::{Session, Wait};

use crate::discovery::{choose_server, visible_servers};
use crate::stop_channel::stop_robot;
use crate::{ClientError, ConnectOptions, session};

/// Timeout of one query, after which it is repeated.
///
/// A step may take longer, because a repeat waits for the request in progress. The timeout is short, because Zenoh
/// keeps state for each query this long.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before the first repeat, doubled each time, and its maximum.
const RETRY_BACKOFF: [Duration; 2] = [Duration::from_millis(2), Duration::from_millis(200)];
/// Time for which another server id must be visible under the robot's name before the server counts as restarted.
///
/// A server that lost its router is visible again within 1 s.
const RESTART_CONFIRMATION: Duration = Duration::from_secs(2);

/// A connection to one server, at which the client has declared its liveliness token.
pub struct Connection {
    endpoint: String,
    timeout: Duration,
    session: Session,
    sid: String,
    name: String,
    client: String,
    secret: Secret,
    /// Maximum size of a request [bytes], from `hello`.
    max_request_bytes: usize,
    /// Maximum number of steps of a rollout, from `hello`; 0 for a server without rollouts.
    max_rollout_steps: u64,
    /// True if the server fronts a robot, from `hello`.
    is_real_time: bool,
    /// Port of the robot's stop channel, from `hello`.
    stop_port: Option<u16>,
    /// Zenoh configuration file.
    zenoh: Option<PathBuf>,
    /// Set by the user to end the wait for a robot that is not ready.
    interrupted: Arc<AtomicBool>,
    /// Key of frequent requests.
    declared: Option<KeyExpr<'static>>,
    _token: LivelinessToken,
}

/// A request in progress.
pub struct Pending {
    request: Request,
    replies: FifoChannelHandler<Reply>,
}

/// What is sent, the first time and in every repeat.
#[derive(Clone)]
struct Request {
    payload: ZBytes,
    /// The secret.
    attachment: ZBytes,
}

/// Result of one query.
enum QueryOutcome {
    Answer(ZBytes),
    Error(ErrorReply),
    /// The query timed out: the server is unresponsive or still executes the request.
    Timeout,
    /// Zero replies: no server answers at the key, or access control denies the query.
    NoReply,
}

impl Connection {
    /// Opens a session, finds the server, declares the client's liveliness token, and requests `hello`.
    ///
    /// Fails if the server does not support this protocol version. `secret` is that of the lease to use.
    pub fn open(options: &ConnectOptions, secret: Secret) -> Result<Self, ClientError> {
        let session = session::open(options)?;
        let (sid, name) = choose_server(&session, options)?;
        let client = format!("{}-{}", session.zid(), random_id());
        let key = keys::live_client(&sid, &client);
        let token = session.liveliness().declare_token(&key).wait().map_err(|error| zenoh_error(&error))?;
        let endpoint = options.endpoint.clone();
        let mut this = Self {
            endpoint,
            timeout: options.timeout,
            session,
            sid,
            name,
            client,
            secret,
            max_request_bytes: usize::MAX,
            max_rollout_steps: 0,
            is_real_time: false,
            stop_port: None,
            zenoh: options.zenoh.clone(),
            interrupted: Arc::clone(&options.interrupted),
            declared: None,
            _token: token,
        };
        let hello = this.hello()?;
        this.max_request_bytes = usize::try_from(hello.max_request_bytes).unwrap_or(usize::MAX);
        this.max_rollout_steps = hello.max_rollout_steps;
        this.is_real_time = hello.real_time.is_some();
        this.stop_port = hello.real_time.and_then(|real_time| real_time.stop_port);
        Ok(this)
    }

    /// Damps the motors of the robot at once, whoever controls it: over its stop channel, or over Zenoh if that fails.
    pub fn stop_robot(&self) -> Result<(), ClientError> {
        if self.stop_port.is_some() && stop_robot(&self.endpoint, self.stop_port, self.zenoh.as_deref()).is_ok() {
            return Ok(());
        }
        self.request(&keys::stop(&self.sid), encode(&message::StopRequest { protocol: PROTOCOL })).map(drop)
    }

    /// Returns the secret that is attached to every request.
    pub fn secret(&self) -> Secret {
        self.secret
    }

    /// Returns the id of the client, as in its liveliness token.
    pub fn client(&self) -> &str {
        &self.client
    }

    /// Returns the Zenoh session.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Returns the id of the server.
    pub fn sid(&self) -> &str {
        &self.sid
    }

    /// Returns the maximum number of steps of a rollout; 0 for a server without rollouts.
    pub fn max_rollout_steps(&self) -> u64 {
        self.max_rollout_steps
    }

    /// Returns true if the server fronts a robot, whose steps take one policy period of real time.
    pub fn is_real_time(&self) -> bool {
        self.is_real_time
    }

    /// Returns true if the server's liveliness token is visible.
    pub fn server_is_visible(&self) -> bool {
        visible_servers(&self.session).iter().any(|(sid, _)| *sid == self.sid)
    }

    /// Declares the key of frequent requests, whose route routers and servers then remember.
    ///
    /// Not a querier: routers and servers keep the key of a querier for ever if the client is lost
    /// ([Zenoh's issue 1518](https://github.com/eclipse-zenoh/zenoh/issues/1518)).
    pub fn declare(&mut self, key: String) -> Result<(), ClientError> {
        self.declared = Some(self.session.declare_keyexpr(key).wait().map_err(|error| zenoh_error(&error))?);
        Ok(())
    }

    /// Sends one query.
    fn get(&self, key: &str, request: &Request) -> Result<FifoChannelHandler<Reply>, ClientError> {
        let Request { payload, attachment } = request.clone();
        let query = match self.declared.as_ref().filter(|declared| declared.as_str() == key) {
            Some(declared) => self.session.get(declared),
            None => self.session.get(key),
        };
        query
            .payload(payload)
            .attachment(attachment)
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .congestion_control(CongestionControl::Block)
            .express(true)
            .timeout(QUERY_TIMEOUT)
            .wait()
            .map_err(|error| zenoh_error(&error))
    }

    fn hello(&self) -> Result<message::HelloReply, ClientError> {
        let client = concat!("twinstep-client ", env!("CARGO_PKG_VERSION")).to_owned();
        let answer =
            self.request(&keys::hello(&self.sid), encode(&message::HelloRequest { protocol: PROTOCOL, client }))?;
        let hello: message::HelloReply = read_answer(&answer, "hello")?;
        if !(hello.protocols[0]..=hello.protocols[1]).contains(&PROTOCOL) {
            return Err(ClientError::Version { theirs: hello.protocols, ours: PROTOCOL });
        }
        Ok(hello)
    }

    /// Sends a request to a key of the server and waits for the reply.
    pub fn request(&self, key: &str, request: Vec<u8>) -> Result<ZBytes, ClientError> {
        self.wait_reply(key, &mut self.send(key, request)?, self.timeout)
    }

    /// Sends a request without waiting for the reply.
    pub fn send(&self, key: &str, payload: Vec<u8>) -> Result<Pending, ClientError> {
        let (bytes, limit) = (payload.len(), self.max_request_bytes);
        if bytes > limit {
            return Err(ClientError::TooLarge { request: key.to_owned(), bytes, limit });
        }
        let request = Request { payload: ZBytes::from(payload), attachment: ZBytes::from(self.secret.as_bytes()) };
        let replies = self.get(key, &request)?;
        Ok(Pending { request, replies })
    }

    /// Waits for the reply to a request and repeats the request until the timeout. May be called again after a timeout.
    pub fn wait_reply(&self, key: &str, pending: &mut Pending, timeout: Duration) -> Result<ZBytes, ClientError> {
        let mut since = Instant::now();
        let mut waiting_for = String::new();
        let mut pause = RETRY_BACKOFF[0];
        let mut replaced_since: Option<Instant> = None;
        loop {
            match outcome(&pending.replies) {
                QueryOutcome::Answer(bytes) => return Ok(bytes),
                QueryOutcome::Error(error) if error.code == ErrorCode::ShuttingDown => {
                    return Err(ClientError::ShuttingDown { endpoint: self.endpoint.clone() });
                }
                QueryOutcome::Error(error) if error.code == ErrorCode::Waiting => {
                    // The robot waits for its operator, who may take any time.
                    since = Instant::now();
                    if self.interrupted.load(Ordering::Acquire) {
                        return Err(ClientError::Interrupted { reason: error.message });
                    }
                    if error.message != waiting_for {
                        eprintln!("{}: {}", self.name, error.message);
                        waiting_for = error.message;
                    }
                }
                QueryOutcome::Error(error) if !error.retryable => return Err(error.into()),
                QueryOutcome::Error(_) | QueryOutcome::Timeout => {}
                QueryOutcome::NoReply => {
                    replaced_since = self.server_restarted().then(|| replaced_since.unwrap_or_else(Instant::now));
                    if replaced_since.is_some_and(|since| since.elapsed() >= RESTART_CONFIRMATION) {
                        return Err(ClientError::Restarted { endpoint: self.endpoint.clone() });
                    }
                }
            }
            if since.elapsed() >= timeout {
                return Err(ClientError::RequestTimeout {
                    endpoint: self.endpoint.clone(),
                    request: key.to_owned(),
                    waited_s: since.elapsed().as_secs_f64(),
                    reason: self.timeout_reason(),
                });
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(RETRY_BACKOFF[1]);
            pending.replies = self.get(key, &pending.request)?;
        }
    }

    /// Returns the time after which an unanswered request fails.
    pub fn timeout(&self) -> Duration {
        self.timeout
    }

    /// Returns true if a server of this robot's name is visible under another id, and this server is not visible.
    fn server_restarted(&self) -> bool {
        let visible = visible_servers(&self.session);
        !visible.iter().any(|(sid, _)| *sid == self.sid) && visible.iter().any(|(_, name)| *name == self.name)
    }

    /// Returns the reason for a timeout, from the state of the session, the liveliness tokens and a `hello` request.
    fn timeout_reason(&self) -> String {
        let info = self.session.info();
        let linked = info.routers_zid().wait().next().is_some() || info.peers_zid().wait().next().is_some();
        if !linked {
            return "the connection is lost and cannot be restored; check that the server or the router is running and \
                    not suspended"
                .to_owned();
        }
        if !self.server_is_visible() {
            // A suspended server that is connected directly does not answer the query for visible servers either.
            return "the server is no longer visible: it has terminated or lost its router, or, without a router, it is \
                    unresponsive"
                .to_owned();
        }
        let request = message::HelloRequest { protocol: PROTOCOL, client: self.client.clone() };
        match self.send(&keys::hello(&self.sid), encode(&request)).map(|hello| outcome(&hello.replies)) {
            Ok(QueryOutcome::Answer(_)) => {
                "the server answers `hello`, but not this request: it is still in progress (increase `timeout`), or \
                 access control or a message size limit rejects it"
            }
            Ok(QueryOutcome::Timeout) => "the server is visible but unresponsive: it does not reply to requests",
            _ => "the server is visible, but queries get no reply: access control may deny queries to this user",
        }
        .to_owned()
    }
}

fn outcome(replies: &FifoChannelHandler<Reply>) -> QueryOutcome {
    let Ok(reply) = replies.recv() else { return QueryOutcome::NoReply };
    match reply.into_result() {
        Ok(sample) => QueryOutcome::Answer(sample.payload().clone()),
        // Zenoh's own errors, such as its timeout, are not MessagePack.
        Err(error) => decode(&error.payload().to_bytes()).map_or(QueryOutcome::Timeout, QueryOutcome::Error),
    }
}

/// Decodes the reply to `request`.
pub fn read_answer<T: serde::de::DeserializeOwned>(answer: &ZBytes, request: &str) -> Result<T, ClientError> {
    decode(&answer.to_bytes())
        .map_err(|error| ClientError::Malformed { request: request.to_owned(), reason: error.message })
}

pub(crate) fn zenoh_error(error: &zenoh::Error) -> ClientError {
    ClientError::Config { path: None, reason: error.to_string() }
}
