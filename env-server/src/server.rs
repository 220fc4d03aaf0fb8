//! One start of the server: its Zenoh session, its desk, its end.

use std::collections::HashMap;
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;
use std::time::Duration;

use twinstep_model::AutoresetMode;
use twinstep_protocol::keys;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Queryable;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use crate::desk::{LeaseManager, LeaseManagerMessage, ServerInfo, dispatch};
use crate::worker::ServerState;
use crate::{EnvFactory, EnvFactoryError, ServerConfig};

/// Requests that may wait at the desk.
const LEASE_QUEUE: usize = 1024;
/// How long clients that ask on are told of the shutdown before the session closes.
pub const SHUTDOWN_GRACE: Duration = Duration::from_millis(200);

/// A running server.
pub struct Server {
    sid: String,
    session: Session,
    queryable: Queryable<()>,
    token: LivelinessToken,
    desk: SyncSender<LeaseManagerMessage>,
    desk_thread: JoinHandle<()>,
    shared: Arc<ServerState>,
}

/// Why a server could not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The Zenoh configuration file was refused.
    #[error("the Zenoh configuration {}: {reason}", path.display())]
    ZenohConfig {
        /// The file.
        path: PathBuf,
        /// What Zenoh said.
        reason: String,
    },
    /// A value was refused by Zenoh.
    #[error("`server.{field}` = {value} is refused by Zenoh: {reason}")]
    Setting {
        /// The key.
        field: &'static str,
        /// Its value.
        value: String,
        /// What Zenoh said.
        reason: String,
    },
    /// The session could not be opened.
    #[error(
        "cannot listen at {listen}: {reason}\n  if another server runs there, give this one another endpoint: \
         `--listen tcp/127.0.0.1:0` takes a free port"
    )]
    Open {
        /// The endpoint.
        listen: String,
        /// What Zenoh said.
        reason: String,
    },
    /// The session refused a declaration.
    #[error("cannot answer at {key}: {reason}")]
    Declare {
        /// The key.
        key: String,
        /// What Zenoh said.
        reason: String,
    },
    /// The environments cannot be built.
    #[error(transparent)]
    Host(#[from] EnvFactoryError),
    /// The system gave no thread.
    #[error("cannot start the desk's thread: {0}")]
    Thread(std::io::Error),
}

impl Server {
    /// Opens Zenoh as `config` says and answers with the environments of `host`.
    pub fn start(config: &ServerConfig, host: Arc<dyn EnvFactory>) -> Result<Self, ServerError> {
        // One environment tells the spec, and that the host can build any.
        let spec = host.build(1, AutoresetMode::NextStep, None)?.spec().clone();
        let sid = random_id();
        let session = zenoh::open(zenoh_config(config)?)
            .wait()
            .map_err(|error| ServerError::Open { listen: config.listen.clone(), reason: error.to_string() })?;
        let (desk, jobs) = sync_channel(LEASE_QUEUE);
        let routes = Arc::new(RwLock::new(HashMap::new()));
        let shared = Arc::new(ServerState { shutting_down: AtomicBool::new(false), env_steps: AtomicU64::new(0) });
        let facts = ServerInfo {
            name: config.name.clone(),
            sid: sid.clone(),
            spec,
            max_envs: config.envs,
            lease_grace: config.lease_grace(),
        };
        let own = LeaseManager::new(facts, host, Arc::clone(&shared), Arc::clone(&routes), desk.clone());
        let desk_thread = std::thread::Builder::new()
            .name("desk".to_owned())
            .spawn(move || own.run(&jobs))
            .map_err(ServerError::Thread)?;
        watch_clients(&session, &sid, desk.clone())?;
        let queryable = {
            let (sid, desk, key) = (sid.clone(), desk.clone(), keys::server(&sid));
            session
                .declare_queryable(&key)
                .complete(true)
                .callback(move |query| dispatch(query, &sid, &routes, &desk))
                .wait()
                .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?
        };
        // Last, so that whoever sees the token is answered.
        let key = keys::live_server(&sid, &config.name);
        let token = session
            .liveliness()
            .declare_token(&key)
            .wait()
            .map_err(|error| ServerError::Declare { key, reason: error.to_string() })?;
        Ok(Self { sid, session, queryable, token, desk, desk_thread, shared })
    }

    /// The server's id, new with each start.
    pub fn sid(&self) -> &str {
        &self.sid
    }

    /// Where the server listens, with the port that the system gave.
    pub fn endpoints(&self) -> Vec<String> {
        self.session.info().locators().wait().iter().map(ToString::to_string).collect()
    }

    /// Environment steps executed so far.
    pub fn env_steps(&self) -> u64 {
        self.shared.env_steps.load(Ordering::Relaxed)
    }

    /// Finishes the steps in progress, tells the clients, and closes the session.
    pub fn shutdown(self) {
        self.shared.shutting_down.store(true, Ordering::Release);
        // Clients that watch see the token go; those that ask get `shutting_down`.
        let _ = self.token.undeclare().wait();
        let _ = self.desk.send(LeaseManagerMessage::Stop);
        std::thread::sleep(SHUTDOWN_GRACE);
        let _ = self.queryable.undeclare().wait();
        let _ = self.desk_thread.join();
        let _ = self.session.close().wait();
    }
}

fn watch_clients(session: &Session, sid: &str, desk: SyncSender<LeaseManagerMessage>) -> Result<(), ServerError> {
    let key = keys::live_clients(sid);
    let own_sid = sid.to_owned();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            if let Some(client) = keys::parse_live_client(sample.key_expr().as_str(), &own_sid) {
                // Blocks only while a thousand requests wait; losing the news would keep a dead client's environments.
                let _ = desk.send(LeaseManagerMessage::Client(client.to_owned(), sample.kind() == SampleKind::Put));
            }
        })
        .background()
        .wait()
        .map_err(|error| ServerError::Declare { key, reason: error.to_string() })
}

/// The Zenoh configuration: the user's file, then what Twinstep relies on.
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
        // A frozen peer is noticed after 2 s in place of Zenoh's 10.
        ("zenoh", "transport/link/tx/lease", "2000"),
        // Room for a step of 4096 robots, which Zenoh sends in twelve parts: with its own two, whoever writes waits for
        // whoever sends after every second part, and whoever receives takes new memory for each.
        ("zenoh", "transport/link/tx/queue/size/data", "16"),
        ("zenoh", "transport/link/rx/buffer_size", "2097152"),
        // A router that comes back is found within a second in place of Zenoh's four.
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

/// Fails if the configuration asks for users and their file names none: Zenoh would then let everyone in.
fn check_users(config: &ServerConfig, zenoh: &zenoh::Config) -> Result<(), ServerError> {
    let Some(path) = &config.zenoh else { return Ok(()) };
    let setting = zenoh.get_json("transport/auth/usrpwd/dictionary_file").unwrap_or_default();
    let Ok(Some(users)) = serde_json::from_str::<Option<PathBuf>>(&setting) else { return Ok(()) };
    let refuse = |reason: String| Err(ServerError::ZenohConfig { path: path.clone(), reason });
    match std::fs::read_to_string(&users) {
        Ok(text) if text.trim().is_empty() => refuse(format!(
            "its `dictionary_file` {} names no user, and Zenoh would let everyone in\n  write one `user:password` a line",
            users.display()
        )),
        Ok(_) => Ok(()),
        Err(error) => refuse(format!("its `dictionary_file` {}: {error}", users.display())),
    }
}

/// A random number from the system's entropy.
pub fn random_u64() -> u64 {
    RandomState::new().build_hasher().finish()
}

/// A random id of 16 hexadecimal digits.
pub fn random_id() -> String {
    format!("{:016x}", random_u64())
}
