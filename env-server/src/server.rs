//! One run of a server: its Zenoh session, its lease manager and its shutdown.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;

use twinstep_model::AutoresetMode;
use twinstep_protocol::keys;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Queryable;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use crate::lease_manager::{LeaseManager, SHUTDOWN_GRACE, ServerInfo, dispatch};
use crate::messages::{LeaseManagerMessage, ServerState};
use crate::random::random_id;
use crate::{EnvFactory, EnvFactoryError, ServerConfig};

/// Capacity of the lease manager's queue.
const LEASE_QUEUE: usize = 1024;

/// A running server.
pub struct Server {
    sid: String,
    session: Session,
    queryable: Queryable<()>,
    token: LivelinessToken,
    lease_queue: SyncSender<LeaseManagerMessage>,
    lease_thread: JoinHandle<()>,
    shared: Arc<ServerState>,
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
    /// The environments cannot be built.
    #[error(transparent)]
    Host(#[from] EnvFactoryError),
    /// The operating system could not start a thread.
    #[error("cannot start the lease manager's thread: {0}")]
    Thread(std::io::Error),
}

impl Server {
    /// Opens a Zenoh session as in `config` and serves the environments that `factory` builds.
    pub fn start(config: &ServerConfig, factory: Arc<dyn EnvFactory>) -> Result<Self, ServerError> {
        // One environment provides the spec, and shows before the first lease that the factory works.
        let spec = factory.build(1, AutoresetMode::NextStep, None)?.spec().clone();
        let sid = random_id();
        let session = twinstep_session::open(zenoh_config(config)?)
            .map_err(|error| ServerError::Open { listen: config.listen.clone(), reason: error.to_string() })?;
        let (lease_queue, jobs) = sync_channel(LEASE_QUEUE);
        let routes = Arc::new(RwLock::new(HashMap::new()));
        let shared = Arc::new(ServerState { shutting_down: AtomicBool::new(false), env_steps: AtomicU64::new(0) });
        let info = ServerInfo {
            name: config.name.clone(),
            sid: sid.clone(),
            spec,
            max_envs: config.envs,
            lease_grace: config.lease_grace(),
        };
        let lease_manager =
            LeaseManager::new(info, factory, Arc::clone(&shared), Arc::clone(&routes), lease_queue.clone());
        let lease_thread = std::thread::Builder::new()
            .name("lease-manager".to_owned())
            .spawn(move || lease_manager.run(&jobs))
            .map_err(ServerError::Thread)?;
        watch_clients(&session, &sid, lease_queue.clone())?;
        let queryable = {
            let (sid, lease_queue, key) = (sid.clone(), lease_queue.clone(), keys::server(&sid));
            session
                .declare_queryable(&key)
                .complete(true)
                .callback(move |query| dispatch(query, &sid, &routes, &lease_queue))
                .wait()
                .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?
        };
        // The token is declared last: a client that sees it can send requests.
        let key = keys::live_server(&sid, &config.name);
        let token = session
            .liveliness()
            .declare_token(&key)
            .wait()
            .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?;
        Ok(Self { sid, session, queryable, token, lease_queue, lease_thread, shared })
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
        self.shared.env_steps.load(Ordering::Relaxed)
    }

    /// Finishes the steps in progress, notifies the clients, and closes the session.
    pub fn shutdown(self) {
        self.shared.shutting_down.store(true, Ordering::Release);
        // Clients detect that the token disappears; new requests get `shutting_down`.
        let _ = self.token.undeclare().wait();
        let _ = self.lease_queue.send(LeaseManagerMessage::Stop);
        std::thread::sleep(SHUTDOWN_GRACE);
        let _ = self.queryable.undeclare().wait();
        let _ = self.lease_thread.join();
        let _ = self.session.close().wait();
    }
}

fn watch_clients(
    session: &Session,
    sid: &str,
    lease_queue: SyncSender<LeaseManagerMessage>,
) -> Result<(), ServerError> {
    let key = keys::live_clients(sid);
    let own_sid = sid.to_owned();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            if let Some(client) = keys::parse_live_client(sample.key_expr().as_str(), &own_sid) {
                // Blocks only while the queue is full. A dropped message would keep the lease of a disconnected client.
                let _ =
                    lease_queue.send(LeaseManagerMessage::Client(client.to_owned(), sample.kind() == SampleKind::Put));
            }
        })
        .background()
        .wait()
        .map_err(|error| ServerError::Declare { key, reason: error.to_string() })
}

/// Returns the Zenoh configuration: the user's file, overridden by the settings that Twinstep requires.
fn zenoh_config(config: &ServerConfig) -> Result<zenoh::Config, ServerError> {
    let mut zenoh = match &config.zenoh {
        Some(path) => zenoh::Config::from_file(path)
            .map_err(|error| ServerError::ZenohConfig { path: path.clone(), reason: error.to_string() })?,
        None => zenoh::Config::default(),
    };
    check_users(config, &zenoh)?;
    let listen = serde_json::json!([config.listen]).to_string();
    let connect = serde_json::json!(config.connect).to_string();
    let settings: [(&'static str, &str, &str); 9] = [
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
        // The connection to a restarted router is restored within 1 s instead of Zenoh's 4 s.
        ("zenoh", "connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"),
        ("shared_memory", "transport/shared_memory/enabled", if config.shared_memory { "true" } else { "false" }),
    ];
    for (field, key, value) in settings {
        zenoh.insert_json5(key, value).map_err(|error| ServerError::Setting {
            field,
            value: value.to_owned(),
            reason: error.to_string(),
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
