//! One run of a server: its Zenoh session, its lease manager and its shutdown.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, PoisonError, RwLock};
use std::thread::JoinHandle;
use std::time::Duration;

use twinstep_model::{AutoresetMode, EnvSpec};
use twinstep_protocol::{convert, keys, random_id};
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Queryable;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use crate::dispatch::{Dispatcher, Routes, refusals};
use crate::executor::{Executor, Mailbox, SendLock};
use crate::frame_publisher::FramePublisher;
use crate::lease_manager::{LeaseHandler, LeaseManager, ServerInfo};
use crate::messages::ServerState;
use crate::protection::{Exposed, check_protection};
use crate::stop_listener::{StopListener, port};
use crate::{EnvFactory, EnvFactoryError, ServerConfig};

/// Size of the `hello` and of the `lease` requests that wait [bytes].
const MAX_CONTROL_BYTES: usize = 64 << 10;
/// Period at which leases are checked for expiry.
const EXPIRY_PERIOD: Duration = Duration::from_millis(100);
/// Time between the start of a shutdown and the end of the session, in which requests get `shutting_down`.
const SHUTDOWN_GRACE: Duration = Duration::from_millis(200);
/// Minimum size of a message that Zenoh accepts [bytes]. Up to it, an oversized request gets an error reply.
const MIN_ZENOH_MESSAGE: usize = 4 << 20;
/// The same for a robot, whose requests are small.
const MIN_ROBOT_MESSAGE: usize = 64 << 10;

/// A running server.
pub struct Server {
    sid: String,
    session: Session,
    queryable: Queryable<()>,
    token: LivelinessToken,
    routes: Routes,
    executor: Executor,
    control_executor: Executor,
    /// Stops a robot beside Zenoh.
    stop_listener: Option<StopListener>,
    /// Ends the expiry thread when it is dropped.
    running: Sender<()>,
    expiry: JoinHandle<()>,
    state: Arc<ServerState>,
    lease_manager: Arc<LeaseManager>,
}

/// Reasons why a server cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The Zenoh configuration file is invalid.
    #[error("Zenoh configuration {}: {reason}", path.display())]
    ZenohConfig {
        /// The file.
        path: PathBuf,
        /// Error of Zenoh.
        reason: String,
    },
    /// Zenoh rejected a value.
    #[error("Zenoh rejects `server.{field}` = {value}: {reason}")]
    Setting {
        /// The key.
        field: &'static str,
        /// Its value.
        value: String,
        /// Error of Zenoh.
        reason: String,
    },
    /// The session could not be opened.
    #[error(
        "cannot listen at {listen}: {reason}\n  if another server uses this endpoint, choose a different one: \
         `--listen tcp/127.0.0.1:0` selects a free port"
    )]
    Open {
        /// The endpoint.
        listen: String,
        /// Error of Zenoh.
        reason: String,
    },
    /// The session rejected a declaration.
    #[error("cannot declare the key {key}: {reason}")]
    Declare {
        /// The key.
        key: String,
        /// Error of Zenoh.
        reason: String,
    },
    /// The stop channel of a robot cannot listen.
    #[error(
        "cannot listen for stops beside {endpoint}: {reason}\n  they need the port after that of the endpoint: choose another"
    )]
    StopListener {
        /// Zenoh's endpoint.
        endpoint: String,
        /// Error of the operating system, or of a certificate.
        reason: String,
    },
    /// The environments cannot be built.
    #[error(transparent)]
    Host(#[from] EnvFactoryError),
    /// The operating system could not start a thread.
    #[error("cannot start a thread of the server: {0}")]
    Thread(std::io::Error),
}

impl Server {
    /// Opens a Zenoh session as in `config` and serves the environments that `factory` builds.
    pub fn start(config: &ServerConfig, factory: Arc<dyn EnvFactory>) -> Result<Self, ServerError> {
        // One environment provides the spec, and shows before the first lease that the factory works.
        let spec = factory.build(1, AutoresetMode::NextStep, None)?.spec().clone();
        let is_robot = factory.real_time().is_some();
        // A robot does not wait for its client, and moves while a client runs: each action is the client's.
        let max_rollout_steps = if is_robot { 0 } else { config.max_rollout_steps };
        let max_request_bytes = max_request_bytes(config.envs, max_rollout_steps, &spec);
        let sid = random_id();
        let min_message = if is_robot { MIN_ROBOT_MESSAGE } else { MIN_ZENOH_MESSAGE };
        let zenoh = zenoh_config(config, (4 * max_request_bytes).max(min_message))?;
        if is_robot {
            check_protection(config, &zenoh).map_err(|Exposed { field, endpoint, reason }| ServerError::Setting {
                field,
                value: endpoint,
                reason: reason.to_owned(),
            })?;
        }
        let protected = zenoh.clone();
        let session = twinstep_session::open(zenoh).map_err(|error| ServerError::Open {
            listen: config.listen.clone(),
            reason: twinstep_session::reason(&error),
        })?;
        let stop_listener =
            if is_robot { Some(start_stop_listener(&session, &config.listen, &protected, &factory)?) } else { None };
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let executor = Executor::start(2 * cores.max(2)).map_err(ServerError::Thread)?;
        // Its threads are for requests that take no time: they do not wait for environments.
        let control_executor = Executor::start(1).map_err(ServerError::Thread)?;
        let state = ServerState { max_rollout_steps, ..ServerState::default() };
        let (routes, state) = (Routes::new(RwLock::new(HashMap::new())), Arc::new(state));
        let name = config.name_of(&spec.robot);
        let info = ServerInfo {
            name: name.clone(),
            sid: sid.clone(),
            spec,
            max_envs: config.envs,
            max_envs_per_client: config.max_envs_per_client.unwrap_or(config.envs).min(config.envs),
            max_request_bytes,
            lease_grace: config.lease_grace(),
            lease_idle: config.lease_idle_s.map(Duration::from_secs_f64),
            stop_port: stop_listener.as_ref().map(StopListener::port),
        };
        let lease_manager = Arc::new(LeaseManager::new(
            info,
            Arc::clone(&factory),
            Arc::clone(&state),
            Arc::clone(&routes),
            executor.clone(),
        ));
        let (running, expiry) = expire_leases(Arc::clone(&lease_manager)).map_err(ServerError::Thread)?;
        watch_clients(&session, &sid, Arc::clone(&lease_manager))?;
        let send_lock = SendLock::default();
        let handler = || LeaseHandler(Arc::clone(&lease_manager));
        let control = || Mailbox::new(&control_executor, "", Arc::clone(&send_lock), MAX_CONTROL_BYTES, handler());
        let dispatcher = Dispatcher {
            sid: sid.clone(),
            routes: Arc::clone(&routes),
            hello: control(),
            lease: control(),
            refusals: refusals(&control_executor, Arc::clone(&send_lock)),
            state: Arc::clone(&state),
            factory,
        };
        let key = keys::server(&sid);
        let queryable = session
            .declare_queryable(&key)
            .complete(true)
            .callback(move |query| dispatcher.dispatch(query))
            .wait()
            .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?;
        // The token is declared last: a client that sees it can send requests.
        let key = keys::live_server(&sid, &name);
        let token = session
            .liveliness()
            .declare_token(&key)
            .wait()
            .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?;
        Ok(Self {
            sid,
            session,
            queryable,
            token,
            routes,
            executor,
            control_executor,
            stop_listener,
            running,
            expiry,
            state,
            lease_manager,
        })
    }

    /// Returns the id of the server, which is new at each start.
    pub fn sid(&self) -> &str {
        &self.sid
    }

    /// Returns the endpoints at which the server listens, with the actual port instead of port 0.
    pub fn endpoints(&self) -> Vec<String> {
        self.session.info().locators().wait().iter().map(ToString::to_string).collect()
    }

    /// Returns the number of environment steps executed so far.
    pub fn env_steps(&self) -> u64 {
        self.state.env_steps.load(Ordering::Relaxed)
    }

    /// Returns what sends scene and frames to those who look at the robots. Stop using it before the shutdown.
    pub fn frame_publisher(&self) -> Result<FramePublisher, ServerError> {
        FramePublisher::declare(&self.session, &self.sid)
            .map_err(|error| ServerError::Declare { key: keys::frame(&self.sid), reason: error.to_string() })
    }

    /// Returns what tells the ids of the clients that have environments.
    pub fn client_ids(&self) -> impl Fn() -> Vec<String> + Send + 'static {
        let lease_manager = Arc::clone(&self.lease_manager);
        move || lease_manager.clients()
    }

    /// Finishes the steps in progress, notifies the clients, and closes the session.
    pub fn shutdown(self) {
        self.state.shutting_down.store(true, Ordering::Release);
        // Clients detect that the token disappears; new requests get `shutting_down`.
        let _ = self.token.undeclare().wait();
        std::thread::sleep(SHUTDOWN_GRACE);
        let _ = self.queryable.undeclare().wait();
        drop(self.running);
        let _ = self.expiry.join();
        self.executor.stop();
        self.control_executor.stop();
        if let Some(listener) = self.stop_listener {
            listener.end();
        }
        // The leases and the lease manager refer to each other.
        self.routes.write().unwrap_or_else(PoisonError::into_inner).clear();
        let _ = self.session.close().wait();
    }
}

/// Listens for stops beside Zenoh's endpoint.
fn start_stop_listener(
    session: &Session,
    listen: &str,
    zenoh: &zenoh::Config,
    factory: &Arc<dyn EnvFactory>,
) -> Result<StopListener, ServerError> {
    // Zenoh replaces an address of all interfaces by one of each, and port 0 by the port that it has.
    let locators = session.info().locators().wait();
    let port = locators.first().and_then(|locator| port(&locator.to_string()));
    let started = StopListener::start(listen, port, zenoh, Arc::clone(factory));
    started.map_err(|error| ServerError::StopListener { endpoint: listen.to_owned(), reason: error.to_string() })
}

/// Returns the maximum size of a request [bytes].
fn max_request_bytes(envs: usize, max_rollout_steps: usize, spec: &EnvSpec) -> usize {
    let rollout = if max_rollout_steps == 0 { 0 } else { convert::MAX_ROLLOUT_REQUEST_BYTES };
    convert::max_request_bytes(envs, spec).max(rollout)
}

/// Starts a thread that releases expired leases until the sender is dropped.
fn expire_leases(lease_manager: Arc<LeaseManager>) -> std::io::Result<(Sender<()>, JoinHandle<()>)> {
    let (running, stopped) = channel();
    let thread = std::thread::Builder::new().name("lease-expiry".to_owned()).spawn(move || {
        while stopped.recv_timeout(EXPIRY_PERIOD) == Err(RecvTimeoutError::Timeout) {
            lease_manager.expire_leases();
        }
    })?;
    Ok((running, thread))
}

fn watch_clients(session: &Session, sid: &str, lease_manager: Arc<LeaseManager>) -> Result<(), ServerError> {
    let key = keys::live_clients(sid);
    let own_sid = sid.to_owned();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            if let Some(client) = keys::parse_live_client(sample.key_expr().as_str(), &own_sid) {
                lease_manager.update_liveliness(client, sample.kind() == SampleKind::Put);
            }
        })
        .background()
        .wait()
        .map_err(|error| ServerError::Declare { key, reason: error.to_string() })
}

/// Returns the Zenoh configuration: the user's file, overridden by the settings that Twinstep requires.
fn zenoh_config(config: &ServerConfig, max_message: usize) -> Result<zenoh::Config, ServerError> {
    let mut zenoh = match &config.zenoh {
        Some(path) => zenoh::Config::from_file(path).map_err(|error| ServerError::ZenohConfig {
            path: path.clone(),
            reason: twinstep_session::reason(&error),
        })?,
        None => zenoh::Config::default(),
    };
    check_users(config, &zenoh)?;
    let listen = serde_json::json!([config.listen]).to_string();
    let connect = serde_json::json!(config.connect).to_string();
    let max_message = max_message.to_string();
    let settings: [(&'static str, &str, &str); 13] = [
        ("listen", "listen/endpoints", &listen),
        ("connect", "connect/endpoints", &connect),
        ("zenoh", "mode", "\"peer\""),
        ("zenoh", "scouting/multicast/enabled", "false"),
        // An unresponsive peer is detected after 2 s instead of Zenoh's 10 s.
        ("zenoh", "transport/link/tx/lease", "2000"),
        // A step of 4096 robots is sent in twelve fragments. With Zenoh's default queue of two, the writing thread
        // waits for the sending thread after every second fragment. With its default buffer, the receiver allocates
        // each one.
        ("zenoh", "transport/link/tx/queue/size/data", "16"),
        ("zenoh", "transport/link/rx/buffer_size", "2097152"),
        // Zenoh would collect messages of up to 1 GiB.
        ("envs", "transport/link/rx/max_message_size", &max_message),
        // A connection that says nothing is closed after 1 s, and a hundred of them keep nobody out.
        ("zenoh", "transport/unicast/accept_timeout", "1000"),
        ("zenoh", "transport/unicast/accept_pending", "1000"),
        // A client that does not read loses its link after 2 s instead of Zenoh's 5 s [µs].
        ("zenoh", "transport/link/tx/queue/congestion_control/block/wait_before_close", "2000000"),
        // The connection to a restarted router is restored within 1 s instead of Zenoh's 4 s.
        ("zenoh", "connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"),
        ("shared_memory", "transport/shared_memory/enabled", if config.shared_memory { "true" } else { "false" }),
    ];
    for (field, key, value) in settings {
        zenoh.insert_json5(key, value).map_err(|error| ServerError::Setting {
            field,
            value: value.to_owned(),
            reason: twinstep_session::reason(&error),
        })?;
    }
    Ok(zenoh)
}

/// Checks that a dictionary file of users, if configured, is not empty. Zenoh would accept every client.
fn check_users(config: &ServerConfig, zenoh: &zenoh::Config) -> Result<(), ServerError> {
    let Some(path) = &config.zenoh else { return Ok(()) };
    let setting = zenoh.get_json("transport/auth/usrpwd/dictionary_file").unwrap_or_default();
    let Ok(Some(users)) = serde_json::from_str::<Option<PathBuf>>(&setting) else { return Ok(()) };
    let reject = |reason: String| Err(ServerError::ZenohConfig { path: path.clone(), reason });
    match std::fs::read_to_string(&users) {
        Ok(text) if text.trim().is_empty() => reject(format!(
            "its `dictionary_file` {} is empty, so Zenoh would accept every client\n  write one `user:password` per line",
            users.display()
        )),
        Ok(_) => Ok(()),
        Err(error) => reject(format!("its `dictionary_file` {}: {error}", users.display())),
    }
}
