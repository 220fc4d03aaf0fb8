//! The lease manager: answers `hello`, grants leases, monitors the liveliness of clients, releases expired leases.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_model::EnvSpec;
use twinstep_protocol::keys::{self, Request};
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, decode, encode, message};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::messages::{LeaseManagerMessage, LeaseParams, ServerState, WorkerRequest};
use crate::random::random_id;
use crate::worker::{Worker, reply, reply_error, shutting_down, stale_epoch};

/// Capacity of a worker's request queue. A client has one request in progress; the rest is for its repeats.
const WORKER_QUEUE: usize = 32;
/// Period at which leases of disconnected clients are checked for expiry.
const EXPIRY_PERIOD: Duration = Duration::from_millis(100);
/// Time between the start of a shutdown and the end of the session, in which requests get `shutting_down`.
pub const SHUTDOWN_GRACE: Duration = Duration::from_millis(200);

/// Worker of each lease, by lease id. Zenoh's threads read it.
pub type WorkerTable = Arc<RwLock<HashMap<String, WorkerHandle>>>;

/// Request queue of a worker, and the time of its last request.
pub struct WorkerHandle {
    jobs: SyncSender<WorkerRequest>,
    /// Time of the client's last request. Keeps the lease alive when the token is not visible.
    last_request: RwLock<Instant>,
}

/// Properties of the server that `hello` reports and leases are granted by.
pub struct ServerInfo {
    /// Name of the robot.
    pub name: String,
    /// Id of the server.
    pub sid: String,
    /// Spec of the environments.
    pub spec: EnvSpec,
    /// Maximum total number of environments.
    pub max_envs: usize,
    /// Time for which the environments of a disconnected client are kept.
    pub lease_grace: Duration,
}

/// Grants leases and releases those of disconnected clients.
pub struct LeaseManager {
    info: ServerInfo,
    factory: Arc<dyn EnvFactory>,
    shared: Arc<ServerState>,
    routes: WorkerTable,
    own_queue: SyncSender<LeaseManagerMessage>,
    leases: HashMap<String, Lease>,
    /// Clients whose liveliness token is visible.
    live_clients: HashSet<String>,
}

struct Lease {
    client: String,
    num_envs: usize,
    /// Fencing token, increased by one at each reclaim; sent to the worker.
    epoch: u64,
    /// Time at which the client's token disappeared; `None` while it is visible.
    disconnected_since: Option<Instant>,
    thread: JoinHandle<()>,
}

/// Enqueues a query at the worker of its lease, or at the lease manager. Never blocks; runs on Zenoh's threads.
pub fn dispatch(query: Query, sid: &str, routes: &WorkerTable, lease_queue: &SyncSender<LeaseManagerMessage>) {
    let Some(Request::Env { lease, verb }) = keys::parse(query.key_expr().as_str(), sid) else {
        // A full queue drops the query. The client gets no reply and repeats it.
        let _ = lease_queue.try_send(LeaseManagerMessage::Query(query));
        return;
    };
    let routes = routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
    match routes.get(lease) {
        None => drop(lease_queue.try_send(LeaseManagerMessage::Query(query.clone()))),
        Some(route) => {
            *route.last_request.write().unwrap_or_else(std::sync::PoisonError::into_inner) = Instant::now();
            if let Err(TrySendError::Full(WorkerRequest::Env(_, query))) =
                route.jobs.try_send(WorkerRequest::Env(verb, query.clone()))
            {
                let message = format!("{WORKER_QUEUE} requests of this lease are already queued");
                let error = ErrorReply::new(ErrorCode::Busy, "", message).with_hint("send one request at a time");
                reply_error(&query, &error);
            }
        }
    }
}

impl LeaseManager {
    /// Creates a lease manager without leases.
    pub fn new(
        info: ServerInfo,
        factory: Arc<dyn EnvFactory>,
        shared: Arc<ServerState>,
        routes: WorkerTable,
        own_queue: SyncSender<LeaseManagerMessage>,
    ) -> Self {
        Self { info, factory, shared, routes, own_queue, leases: HashMap::new(), live_clients: HashSet::new() }
    }

    /// Handles messages until [`LeaseManagerMessage::Stop`], then waits for the workers. Runs on a thread of its own.
    pub fn run(mut self, jobs: &Receiver<LeaseManagerMessage>) {
        loop {
            match jobs.recv_timeout(EXPIRY_PERIOD) {
                Ok(LeaseManagerMessage::Query(query)) => self.answer(&query),
                Ok(LeaseManagerMessage::Client(client, present)) => self.update_liveliness(client, present),
                Ok(LeaseManagerMessage::Closed(lease)) => self.release(&lease, "closed by its client"),
                Ok(LeaseManagerMessage::Stop) | Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
            self.expire_leases();
        }
        self.routes.write().unwrap_or_else(std::sync::PoisonError::into_inner).clear();
        for (_, lease) in self.leases.drain() {
            // The worker caught, logged and reported its panics.
            let _ = lease.thread.join();
        }
        // Further requests get `shutting_down` until the server closes its session.
        while let Ok(job) = jobs.recv_timeout(SHUTDOWN_GRACE) {
            if let LeaseManagerMessage::Query(query) = job {
                reply_error(&query, &shutting_down());
            }
        }
    }

    fn answer(&mut self, query: &Query) {
        let result = match keys::parse(query.key_expr().as_str(), &self.info.sid) {
            Some(Request::Hello) => self.hello(query),
            Some(Request::Lease) => return self.lease(query),
            Some(Request::Env { lease, .. }) => {
                let message = format!("lease `{lease}` does not exist: it was closed, expired, or was never granted");
                Err(ErrorReply::new(ErrorCode::LeaseLost, "lease", message).with_hint("request a new lease"))
            }
            None => {
                let message = format!("the key `{}` does not exist", query.key_expr());
                let hint = "use hello, lease, or env/<lease>/reset, step, close or render";
                Err(ErrorReply::new(ErrorCode::UnknownKey, "", message).with_hint(hint))
            }
        };
        match result {
            Ok(bytes) => reply(query, ZBytes::from(bytes)),
            Err(error) => reply_error(query, &error),
        }
    }

    fn hello(&self, query: &Query) -> Result<Vec<u8>, ErrorReply> {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        // A client of any version gets a reply, which contains the supported versions.
        if let Err(error) = decode::<message::HelloRequest>(&payload)
            && error.code != ErrorCode::Version
        {
            return Err(error);
        }
        Ok(encode(&message::HelloReply {
            protocol: PROTOCOL,
            protocols: [PROTOCOL, PROTOCOL],
            server_version: concat!("twinstep ", env!("CARGO_PKG_VERSION")).to_owned(),
            name: self.info.name.clone(),
            server_id: self.info.sid.clone(),
            spec_hash: self.info.spec.hash(),
            spec: self.info.spec.clone(),
            max_envs: self.info.max_envs as u64,
            free_envs: self.free_envs() as u64,
            lease_grace_s: self.info.lease_grace.as_secs_f64(),
            env_steps: self.shared.env_steps.load(Ordering::Relaxed),
        }))
    }

    fn free_envs(&self) -> usize {
        self.info.max_envs - self.leases.values().map(|lease| lease.num_envs).sum::<usize>()
    }

    /// Forwards the request to the worker of the lease, which replies. Starts a worker for a new lease.
    fn lease(&mut self, query: &Query) {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let result = decode::<message::LeaseRequest>(&payload).and_then(|request| {
            self.check_lease_request(&request)?;
            match &request.reclaim {
                Some(reclaim) => self.reclaim(&request.client, reclaim, query),
                None => self.grant(&request, query),
            }
        });
        if let Err(error) = result {
            reply_error(query, &error);
        }
    }

    fn check_lease_request(&self, request: &message::LeaseRequest) -> Result<(), ErrorReply> {
        let reject = |code, field: &str, message: String| Err(ErrorReply::new(code, field, message));
        if request.protocol != PROTOCOL {
            return Err(ErrorReply::version(request.protocol));
        }
        let is_id = |character: char| character.is_ascii_alphanumeric() || matches!(character, '-' | '_');
        if request.client.is_empty() || request.client.len() > 64 || !request.client.chars().all(is_id) {
            return reject(
                ErrorCode::OutOfRange,
                "client",
                "`client` must be 1 to 64 letters, digits, - and _".to_owned(),
            );
        }
        if request.num_envs == 0 {
            return reject(ErrorCode::OutOfRange, "num_envs", "`num_envs` = 0; must be at least 1".to_owned());
        }
        if request.max_episode_steps == Some(0) {
            let message = "`max_episode_steps` = 0; must be at least 1".to_owned();
            return reject(ErrorCode::OutOfRange, "max_episode_steps", message);
        }
        let ours = self.info.spec.hash();
        if let Some(theirs) = request.spec_hash.as_ref().filter(|theirs| **theirs != ours) {
            let message = format!("`spec_hash` = {theirs} differs from this server's, {ours}");
            let hint = "the policy was trained for different observations, joint order, periods, gains, action scale or \
                        default pose; compare its spec with the one in `hello`";
            return Err(ErrorReply::new(ErrorCode::SpecMismatch, "spec_hash", message).with_hint(hint));
        }
        Ok(())
    }

    fn grant(&mut self, request: &message::LeaseRequest, query: &Query) -> Result<(), ErrorReply> {
        let held = self.leases.iter().find(|(_, lease)| lease.client == request.client);
        if let Some((id, lease)) = held {
            if lease.num_envs as u64 == request.num_envs {
                return self.forward(id, WorkerRequest::Lease { query: query.clone(), epoch: lease.epoch });
            }
            let message = format!("client `{}` already has a lease of {} environments", request.client, lease.num_envs);
            return Err(ErrorReply::new(ErrorCode::OutOfRange, "client", message)
                .with_hint("close that lease first, or use another client id"));
        }
        let free = self.free_envs();
        if request.num_envs > free as u64 {
            let message =
                format!("`num_envs` = {} is too large: {free} of {} are free", request.num_envs, self.info.max_envs);
            return Err(ErrorReply::new(ErrorCode::TooManyEnvs, "num_envs", message)
                .with_hint("request fewer, or start the server with a larger `--envs`"));
        }
        let id = random_id();
        self.start_worker(&id, request)?;
        self.forward(&id, WorkerRequest::Lease { query: query.clone(), epoch: 1 })
    }

    fn start_worker(&mut self, id: &str, request: &message::LeaseRequest) -> Result<(), ErrorReply> {
        let num_envs = request.num_envs as usize;
        let grant = LeaseParams {
            lease: id.to_owned(),
            num_envs,
            autoreset: request.autoreset,
            max_episode_steps: request.max_episode_steps,
            critic: request.critic,
        };
        let (sender, receiver) = sync_channel(WORKER_QUEUE);
        let (factory, shared, lease_queue) =
            (Arc::clone(&self.factory), Arc::clone(&self.shared), self.own_queue.clone());
        let thread = std::thread::Builder::new()
            .name(format!("lease-{id}"))
            .spawn(move || Worker::run(grant, &*factory, shared, lease_queue, &receiver))
            .map_err(|error| {
                ErrorReply::new(ErrorCode::Internal, "", format!("cannot start a thread for the lease: {error}"))
            })?;
        tracing::info!(lease = id, client = request.client, num_envs, "lease granted");
        let route = WorkerHandle { jobs: sender, last_request: RwLock::new(Instant::now()) };
        self.routes.write().unwrap_or_else(std::sync::PoisonError::into_inner).insert(id.to_owned(), route);
        let disconnected_since = (!self.live_clients.contains(&request.client)).then(Instant::now);
        let lease = Lease { client: request.client.clone(), num_envs, epoch: 1, disconnected_since, thread };
        self.leases.insert(id.to_owned(), lease);
        Ok(())
    }

    fn reclaim(&mut self, client: &str, reclaim: &message::Reclaim, query: &Query) -> Result<(), ErrorReply> {
        let Some(lease) = self.leases.get(&reclaim.lease) else {
            let message = format!("lease `{}` does not exist: it was closed or expired", reclaim.lease);
            return Err(
                ErrorReply::new(ErrorCode::LeaseLost, "reclaim.lease", message).with_hint("request a new lease")
            );
        };
        let epoch = lease.epoch;
        // The reply to the new owner was lost: repeat it with the same epoch.
        let repeated = lease.client == client && reclaim.epoch == epoch - 1;
        if !repeated && reclaim.epoch != epoch {
            return Err(stale_epoch("reclaim.epoch", reclaim.epoch, epoch));
        }
        let epoch = if repeated { epoch } else { epoch + 1 };
        self.forward(&reclaim.lease, WorkerRequest::Lease { query: query.clone(), epoch })?;
        let disconnected_since = (!self.live_clients.contains(client)).then(Instant::now);
        if let Some(lease) = self.leases.get_mut(&reclaim.lease) {
            (lease.client, lease.epoch, lease.disconnected_since) = (client.to_owned(), epoch, disconnected_since);
        }
        Ok(())
    }

    fn forward(&self, lease: &str, job: WorkerRequest) -> Result<(), ErrorReply> {
        let routes = self.routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
        let sent = routes.get(lease).is_some_and(|route| route.jobs.try_send(job).is_ok());
        if sent { Ok(()) } else { Err(ErrorReply::new(ErrorCode::Busy, "", "the request queue of this lease is full")) }
    }

    fn update_liveliness(&mut self, client: String, present: bool) {
        for (id, lease) in self.leases.iter_mut().filter(|(_, lease)| lease.client == client) {
            tracing::info!(lease = id, client, present, "client liveliness changed");
            lease.disconnected_since = (!present).then(Instant::now);
        }
        if present {
            self.live_clients.insert(client);
        } else {
            self.live_clients.remove(&client);
        }
    }

    fn expire_leases(&mut self) {
        let grace = self.info.lease_grace;
        let expired: Vec<String> = {
            let routes = self.routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
            let is_idle = |id: &String| {
                routes.get(id).is_none_or(|route| {
                    route.last_request.read().unwrap_or_else(std::sync::PoisonError::into_inner).elapsed() > grace
                })
            };
            let is_disconnected = |lease: &Lease| lease.disconnected_since.is_some_and(|since| since.elapsed() > grace);
            self.leases
                .iter()
                .filter(|(id, lease)| is_disconnected(lease) && is_idle(id))
                .map(|(id, _)| id.clone())
                .collect()
        };
        for id in expired {
            self.release(&id, "its client is disconnected and the grace period has passed");
        }
    }

    /// Removes a lease. Its worker terminates after the request in progress.
    fn release(&mut self, lease: &str, reason: &str) {
        if self.leases.remove(lease).is_some() {
            tracing::info!(lease, reason, "lease released");
        }
        self.routes.write().unwrap_or_else(std::sync::PoisonError::into_inner).remove(lease);
    }
}
