//! The connection to one server: opening, finding, asking until answered, and saying why not.

use std::net::{TcpStream, ToSocketAddrs};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use twinstep_model::AutoresetMode;
use twinstep_protocol::{ErrorCode, PROTOCOL, ErrorReply, decode, encode, keys, message};
use zenoh::bytes::ZBytes;
use zenoh::handlers::FifoChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Querier, QueryTarget, Reply};
use zenoh::{Session, Wait};

use crate::ClientError;

/// How long one query may take before it is repeated. A repeat waits for the request in progress, so that a step may
/// take longer; Zenoh keeps state for every query this long, so that it must stay short.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before a repeat, doubled each time up to the second.
const RETRY_BACKOFF: [Duration; 2] = [Duration::from_millis(2), Duration::from_millis(200)];
/// How long another server must stand in the place of ours before ours counts as restarted. A server that lost its
/// router is back within a second.
const RESTART_CONFIRMATION: Duration = Duration::from_secs(2);
/// How long a port may take to accept a connection.
const PROBE_TIMEOUT: Duration = Duration::from_secs(1);

/// Where to connect and what to ask for.
#[derive(Clone, Debug)]
pub struct ConnectOptions {
    /// Zenoh endpoint of the server or of a router, such as `tcp/127.0.0.1:7447`.
    pub endpoint: String,
    /// The robot's name; needed where several are visible.
    pub robot: Option<String>,
    /// Number of environments.
    pub num_envs: usize,
    /// When an ended episode starts anew.
    pub autoreset: AutoresetMode,
    /// Policy steps after which an episode is truncated; the server's own number without.
    pub max_episode_steps: Option<u32>,
    /// Refuse a server with another spec hash, as stored with a policy.
    pub spec_hash: Option<String>,
    /// Zenoh configuration (JSON5) for TLS, user and password.
    pub zenoh: Option<PathBuf>,
    /// Move large messages through shared memory when both ends are on one machine.
    pub shared_memory: bool,
    /// How long to try to connect.
    pub connect_timeout: Duration,
    /// How long to repeat a request before giving up.
    pub timeout: Duration,
}

impl ConnectOptions {
    /// `num_envs` environments of the one server at `endpoint`, with the usual waiting times.
    pub fn new(endpoint: impl Into<String>, num_envs: usize) -> Self {
        Self {
            endpoint: endpoint.into(),
            robot: None,
            num_envs,
            autoreset: AutoresetMode::NextStep,
            max_episode_steps: None,
            spec_hash: None,
            zenoh: None,
            shared_memory: false,
            connect_timeout: Duration::from_secs(5),
            timeout: Duration::from_secs(20),
        }
    }
}

/// A connection to one server, with the client's liveliness token declared.
pub struct Connection {
    endpoint: String,
    timeout: Duration,
    session: Session,
    sid: String,
    name: String,
    client: String,
    _token: LivelinessToken,
}

/// A request that was sent and not yet answered.
pub struct Pending {
    payload: ZBytes,
    replies: FifoChannelHandler<Reply>,
}

/// What became of one query.
enum QueryOutcome {
    Answer(ZBytes),
    Error(ErrorReply),
    /// The query timed out: the server is frozen, or still executing.
    Timeout,
    /// Zero replies: nobody is there, or somebody on the way refused.
    NoReply,
}

impl Connection {
    /// Connects, finds the server, and declares the client's token there.
    pub fn open(options: &ConnectOptions) -> Result<Self, ClientError> {
        let session = open_session(options)?;
        let (sid, name) = find_server(&session, options)?;
        let client = random_id(&session);
        let key = keys::live_client(&sid, &client);
        let token = session.liveliness().declare_token(&key).wait().map_err(|error| refused_by_zenoh(&error))?;
        let endpoint = options.endpoint.clone();
        Ok(Self { endpoint, timeout: options.timeout, session, sid, name, client, _token: token })
    }

    /// The client's id, as in its liveliness token.
    pub fn client(&self) -> &str {
        &self.client
    }

    /// The server's id.
    pub fn sid(&self) -> &str {
        &self.sid
    }

    /// A querier for one key of the server.
    pub fn querier(&self, key: String) -> Result<Querier<'static>, ClientError> {
        self.session
            .declare_querier(key)
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .congestion_control(CongestionControl::Block)
            .express(true)
            .timeout(QUERY_TIMEOUT)
            .wait()
            .map_err(|error| refused_by_zenoh(&error))
    }

    /// Asks the server who it is, and fails if it speaks another protocol.
    pub fn hello(&self) -> Result<message::HelloReply, ClientError> {
        let querier = self.querier(keys::hello(&self.sid))?;
        let client = concat!("twinstep-client ", env!("CARGO_PKG_VERSION")).to_owned();
        let answer = self.request(&querier, encode(&message::HelloRequest { protocol: PROTOCOL, client }))?;
        let hello: message::HelloReply = read_answer(&answer, "hello")?;
        if !(hello.protocols[0]..=hello.protocols[1]).contains(&PROTOCOL) {
            return Err(ClientError::Version { theirs: hello.protocols, ours: PROTOCOL });
        }
        Ok(hello)
    }

    /// Sends a request and waits for its answer.
    pub fn request(&self, querier: &Querier<'static>, request: Vec<u8>) -> Result<ZBytes, ClientError> {
        self.wait_reply(querier, &mut send(querier, request)?)
    }

    /// Waits for the answer to a request, repeating it until the timeout. May be called again after a timeout.
    pub fn wait_reply(&self, querier: &Querier<'static>, pending: &mut Pending) -> Result<ZBytes, ClientError> {
        let since = Instant::now();
        let mut pause = RETRY_BACKOFF[0];
        let mut replaced_since: Option<Instant> = None;
        loop {
            match outcome(&pending.replies) {
                QueryOutcome::Answer(bytes) => return Ok(bytes),
                QueryOutcome::Error(error) if error.code == ErrorCode::ShuttingDown => {
                    return Err(ClientError::ShuttingDown { endpoint: self.endpoint.clone() });
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
            if since.elapsed() >= self.timeout {
                return Err(ClientError::RequestTimeout {
                    endpoint: self.endpoint.clone(),
                    request: querier.key_expr().to_string(),
                    waited_s: since.elapsed().as_secs_f64(),
                    reason: self.timeout_reason(),
                });
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(RETRY_BACKOFF[1]);
            pending.replies = get(querier, &pending.payload)?;
        }
    }

    /// True if another start of a server with this robot's name is visible and this one is not.
    fn server_restarted(&self) -> bool {
        let visible = visible_servers(&self.session);
        !visible.iter().any(|(sid, _)| *sid == self.sid) && visible.iter().any(|(_, name)| *name == self.name)
    }

    /// Which of the reasons for silence it is.
    fn timeout_reason(&self) -> String {
        let info = self.session.info();
        let linked = info.routers_zid().wait().next().is_some() || info.peers_zid().wait().next().is_some();
        if !linked {
            return "the connection is down and could not be opened again; is the server or the router still running?"
                .to_owned();
        }
        if !visible_servers(&self.session).iter().any(|(sid, _)| *sid == self.sid) {
            return "the connection stands, but the server is gone from it: it ended, or its own link to the router did"
                .to_owned();
        }
        let hello = self.querier(keys::hello(&self.sid)).and_then(|querier| {
            let request = message::HelloRequest { protocol: PROTOCOL, client: self.client.clone() };
            Ok(outcome(&send(&querier, encode(&request))?.replies))
        });
        match hello {
            Ok(QueryOutcome::Answer(_)) => {
                "the server answers `hello`, but not this: it is still executing the request (raise `timeout`), or \
                 access control or a message size limit on the way refuses it"
            }
            Ok(QueryOutcome::Timeout) => "the server is visible but frozen: it accepts requests and answers none",
            _ => "the server is visible but nothing comes back: access control may deny queries to this user",
        }
        .to_owned()
    }
}

/// Sends a request without waiting for its answer.
pub fn send(querier: &Querier<'static>, request: Vec<u8>) -> Result<Pending, ClientError> {
    let payload = ZBytes::from(request);
    let replies = get(querier, &payload)?;
    Ok(Pending { payload, replies })
}

fn get(querier: &Querier<'static>, payload: &ZBytes) -> Result<FifoChannelHandler<Reply>, ClientError> {
    querier.get().payload(payload.clone()).wait().map_err(|error| refused_by_zenoh(&error))
}

fn outcome(replies: &FifoChannelHandler<Reply>) -> QueryOutcome {
    let Ok(reply) = replies.recv() else { return QueryOutcome::NoReply };
    match reply.into_result() {
        Ok(sample) => QueryOutcome::Answer(sample.payload().clone()),
        // Zenoh's own errors, such as its timeout, are not ours to decode.
        Err(error) => decode(&error.payload().to_bytes()).map_or(QueryOutcome::Timeout, QueryOutcome::Error),
    }
}

/// Reads the answer to `request`.
pub fn read_answer<T: serde::de::DeserializeOwned>(answer: &ZBytes, request: &str) -> Result<T, ClientError> {
    decode(&answer.to_bytes())
        .map_err(|error| ClientError::Malformed { request: request.to_owned(), reason: error.message })
}

fn open_session(options: &ConnectOptions) -> Result<Session, ClientError> {
    let since = Instant::now();
    loop {
        let config = zenoh_config(options)?;
        match zenoh::open(config).wait() {
            Ok(session) => return Ok(session),
            Err(error) if since.elapsed() >= options.connect_timeout => {
                return Err(ClientError::NoServer {
                    endpoint: options.endpoint.clone(),
                    waited_s: since.elapsed().as_secs_f64(),
                    reason: without_source_line(&error.to_string()),
                    port_open: port_open(&options.endpoint),
                });
            }
            Err(_) => std::thread::sleep(RETRY_BACKOFF[1]),
        }
    }
}

/// Zenoh's errors end with the place in Zenoh's source where they arose.
fn without_source_line(error: &str) -> String {
    error.split(" at /").next().unwrap_or(error).trim_end().to_owned()
}

/// True if a program accepts connections at the endpoint: a server that refuses a client does, an absent one does not.
fn port_open(endpoint: &str) -> bool {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, rest)| rest);
    let address = address.split(['?', '#']).next().unwrap_or_default();
    let mut addresses = address.to_socket_addrs().into_iter().flatten();
    addresses.any(|address| TcpStream::connect_timeout(&address, PROBE_TIMEOUT).is_ok())
}

fn zenoh_config(options: &ConnectOptions) -> Result<zenoh::Config, ClientError> {
    let refuse = |reason: String| ClientError::Config { path: options.zenoh.clone(), reason };
    let mut config = match &options.zenoh {
        Some(path) => zenoh::Config::from_file(path).map_err(|error| refuse(error.to_string()))?,
        None => zenoh::Config::default(),
    };
    let endpoints = serde_json::json!([options.endpoint]).to_string();
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", endpoints.as_str()),
        ("scouting/multicast/enabled", "false"),
        ("transport/link/tx/lease", "2000"),
        // Room for a step of 4096 robots, which Zenoh sends in twelve parts: with its own two, whoever writes waits for
        // whoever sends after every second part, and whoever receives takes new memory for each.
        ("transport/link/tx/queue/size/data", "16"),
        ("transport/link/rx/buffer_size", "2097152"),
        // A server or router that comes back is found within a second in place of Zenoh's four.
        ("connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"),
        ("transport/shared_memory/enabled", if options.shared_memory { "true" } else { "false" }),
    ] {
        config.insert_json5(key, value).map_err(|error| refuse(format!("`{key}` = {value}: {error}")))?;
    }
    Ok(config)
}

/// Server id and robot name of every visible server.
fn visible_servers(session: &Session) -> Vec<(String, String)> {
    let Ok(replies) = session.liveliness().get(keys::LIVE_SERVERS).timeout(QUERY_TIMEOUT).wait() else {
        return Vec::new();
    };
    let mut servers: Vec<(String, String)> = std::iter::from_fn(|| replies.recv().ok())
        .filter_map(|reply| reply.into_result().ok())
        .filter_map(|sample| {
            let (sid, name) = keys::parse_live_server(sample.key_expr().as_str())?;
            Some((sid.to_owned(), name.to_owned()))
        })
        .collect();
    servers.sort();
    servers.dedup();
    servers
}

fn find_server(session: &Session, options: &ConnectOptions) -> Result<(String, String), ClientError> {
    let since = Instant::now();
    loop {
        let visible = visible_servers(session);
        let fits = |name: &str| options.robot.as_ref().is_none_or(|wanted| wanted == name);
        let mut fitting: Vec<_> = visible.iter().filter(|(_, name)| fits(name)).cloned().collect();
        match (fitting.pop(), fitting.is_empty()) {
            (Some(server), true) => return Ok(server),
            // A restarted server's old token may still be there for a moment.
            _ if since.elapsed() < options.connect_timeout => std::thread::sleep(RETRY_BACKOFF[1] / 4),
            (None, _) if visible.is_empty() => {
                let waited_s = since.elapsed().as_secs_f64();
                return Err(ClientError::NoServerVisible { endpoint: options.endpoint.clone(), waited_s });
            }
            (found, _) => {
                let count = fitting.len() + usize::from(found.is_some());
                let wanted = match &options.robot {
                    Some(robot) => format!("{count} robots are named `{robot}`"),
                    None => format!("{count} robots are there and none was named"),
                };
                let visible = visible.iter().map(|(sid, name)| format!("{name} ({sid})")).collect();
                return Err(ClientError::AmbiguousRobot { wanted, visible });
            }
        }
    }
}

fn random_id(session: &Session) -> String {
    use std::hash::{BuildHasher, Hasher};
    let number = std::hash::RandomState::new().build_hasher().finish();
    format!("{}-{number:016x}", session.zid())
}

fn refused_by_zenoh(error: &zenoh::Error) -> ClientError {
    ClientError::Config { path: None, reason: error.to_string() }
}
