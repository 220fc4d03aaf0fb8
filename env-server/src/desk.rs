//! The desk: greets, grants leases, watches which clients live, frees what is lost.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_model::EnvSpec;
use twinstep_protocol::keys::{self, Request};
use twinstep_protocol::{ErrorCode, PROTOCOL, ErrorReply, decode, encode, message};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::server::{SHUTDOWN_GRACE, random_id};
use crate::worker::{LeaseParams, WorkerRequest, ServerState, Worker, reply, reply_error, shutting_down, stale_epoch};

/// Requests that may wait at one worker. A client has one under way; the rest is room for its repeats.
const WORKER_QUEUE: usize = 32;
/// How often the desk looks for lost clients.
const EXPIRY_PERIOD: Duration = Duration::from_millis(100);

/// What the desk is told.
pub enum LeaseManagerMessage {
    /// A query that is not for a lease's worker.
    Query(Query),
    /// A client's liveliness token appeared (true) or went (false).
    Client(String, bool),
    /// A worker's lease is over.
    Closed(String),
    /// Answer nothing new, and end when the workers have.
    Stop,
}

/// Routes from a lease to its worker; Zenoh's threads read it.
pub type WorkerTable = Arc<RwLock<HashMap<String, WorkerHandle>>>;

/// How a worker is reached.
pub struct WorkerHandle {
    jobs: SyncSender<WorkerRequest>,
    /// When its client last asked something; proof of life besides the token.
    last_request: RwLock<Instant>,
}

/// What the server is, for `hello` and for grants.
pub struct ServerInfo {
    /// The robot's name.
    pub name: String,
    /// The server's id.
    pub sid: String,
    /// Layouts, periods, gains and limits.
    pub spec: EnvSpec,
    /// The most environments hosted in all.
    pub max_envs: usize,
    /// Time that a lost client's environments wait for it.
    pub lease_grace: Duration,
}

/// Grants and watches leases.
pub struct LeaseManager {
    facts: ServerInfo,
    host: Arc<dyn EnvFactory>,
    shared: Arc<ServerState>,
    routes: WorkerTable,
    own_queue: SyncSender<LeaseManagerMessage>,
    leases: HashMap<String, Lease>,
    /// Clients whose token is visible.
    live_clients: HashSet<String>,
}

struct Lease {
    client: String,
    num_envs: usize,
    /// Goes up with every reclaim; the worker follows.
    epoch: u64,
    /// Since when the client's token is gone; `None` while it is there.
    disconnected_since: Option<Instant>,
    thread: JoinHandle<()>,
}

/// Takes a query where it belongs, without ever waiting. Runs on Zenoh's threads.
pub fn dispatch(query: Query, sid: &str, routes: &WorkerTable, desk: &SyncSender<LeaseManagerMessage>) {
    let Some(Request::Env { lease, verb }) = keys::parse(query.key_expr().as_str(), sid) else {
        // A full desk drops the query; the client sees no reply and repeats it.
        let _ = desk.try_send(LeaseManagerMessage::Query(query));
        return;
    };
    let routes = routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
    match routes.get(lease) {
        None => drop(desk.try_send(LeaseManagerMessage::Query(query.clone()))),
        Some(route) => {
            *route.last_request.write().unwrap_or_else(std::sync::PoisonError::into_inner) = Instant::now();
            if let Err(TrySendError::Full(WorkerRequest::Env(_, query))) = route.jobs.try_send(WorkerRequest::Env(verb, query.clone())) {
                let message = format!("{WORKER_QUEUE} requests of this lease wait already");
                let error = ErrorReply::new(ErrorCode::Busy, "", message).with_hint("have one request under way at a time");
                reply_error(&query, &error);
            }
        }
    }
}

impl LeaseManager {
    /// A desk without leases.
    pub fn new(
        facts: ServerInfo,
        host: Arc<dyn EnvFactory>,
        shared: Arc<ServerState>,
        routes: WorkerTable,
        own_queue: SyncSender<LeaseManagerMessage>,
    ) -> Self {
        Self { facts, host, shared, routes, own_queue, leases: HashMap::new(), live_clients: HashSet::new() }
    }

    /// Serves until told to stop, then waits for the workers. Runs on the desk's own thread.
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
            // A worker's panic was caught, logged and answered where it happened.
            let _ = lease.thread.join();
        }
        // Clients that ask on are told, until the server closes its session.
        while let Ok(job) = jobs.recv_timeout(SHUTDOWN_GRACE) {
            if let LeaseManagerMessage::Query(query) = job {
                reply_error(&query, &shutting_down());
            }
        }
    }

    fn answer(&mut self, query: &Query) {
        let result = match keys::parse(query.key_expr().as_str(), &self.facts.sid) {
            Some(Request::Hello) => self.hello(query),
            Some(Request::Lease) => return self.lease(query),
            Some(Request::Env { lease, .. }) => {
                let message = format!("there is no lease `{lease}`: it was closed, its grace passed, or it never was");
                Err(ErrorReply::new(ErrorCode::LeaseLost, "lease", message).with_hint("ask for a new lease"))
            }
            None => {
                let message = format!("nothing is answered at `{}`", query.key_expr());
                let hint = "ask at hello, lease, or env/<lease>/reset, step, close or render";
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
        // Any version may ask, so that it learns which are spoken.
        if let Err(error) = decode::<message::HelloRequest>(&payload)
            && error.code != ErrorCode::Version
        {
            return Err(error);
        }
        Ok(encode(&message::HelloReply {
            protocol: PROTOCOL,
            protocols: [PROTOCOL, PROTOCOL],
            server_version: concat!("twinstep ", env!("CARGO_PKG_VERSION")).to_owned(),
            name: self.facts.name.clone(),
            server_id: self.facts.sid.clone(),
            spec_hash: self.facts.spec.hash(),
            spec: self.facts.spec.clone(),
            max_envs: self.facts.max_envs as u64,
            free_envs: self.free_envs() as u64,
            lease_grace_s: self.facts.lease_grace.as_secs_f64(),
            env_steps: self.shared.env_steps.load(Ordering::Relaxed),
        }))
    }

    fn free_envs(&self) -> usize {
        self.facts.max_envs - self.leases.values().map(|lease| lease.num_envs).sum::<usize>()
    }

    /// Passes the request to the lease's worker, which knows its epoch; starts one for a new lease.
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
        let refuse = |code, field: &str, message: String| Err(ErrorReply::new(code, field, message));
        if request.protocol != PROTOCOL {
            return Err(ErrorReply::version(request.protocol));
        }
        let is_id = |character: char| character.is_ascii_alphanumeric() || matches!(character, '-' | '_');
        if request.client.is_empty() || request.client.len() > 64 || !request.client.chars().all(is_id) {
            return refuse(ErrorCode::OutOfRange, "client", "`client` must be 1 to 64 letters, digits, - and _".to_owned());
        }
        if request.num_envs == 0 {
            return refuse(ErrorCode::OutOfRange, "num_envs", "`num_envs` = 0; at least 1 is wanted".to_owned());
        }
        if request.max_episode_steps == Some(0) {
            return refuse(ErrorCode::OutOfRange, "max_episode_steps", "`max_episode_steps` = 0; at least 1".to_owned());
        }
        let ours = self.facts.spec.hash();
        if let Some(theirs) = request.spec_hash.as_ref().filter(|theirs| **theirs != ours) {
            let message = format!("`spec_hash` = {theirs} is not this server's: it is {ours}");
            let hint = "the agent was made for other observations, joint order, rates, gains, scale or pose; \
                        compare its spec with the one in `hello`";
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
            let message = format!("client `{}` holds {} environments already", request.client, lease.num_envs);
            return Err(ErrorReply::new(ErrorCode::OutOfRange, "client", message)
                .with_hint("close the lease first, or ask under another client id"));
        }
        let free = self.free_envs();
        if request.num_envs > free as u64 {
            let message =
                format!("`num_envs` = {} are too many: {free} of {} are free", request.num_envs, self.facts.max_envs);
            return Err(ErrorReply::new(ErrorCode::TooManyEnvs, "num_envs", message)
                .with_hint("ask for fewer, or start the server with a larger `--envs`"));
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
        };
        let (sender, receiver) = sync_channel(WORKER_QUEUE);
        let (host, shared, desk) = (Arc::clone(&self.host), Arc::clone(&self.shared), self.own_queue.clone());
        let thread = std::thread::Builder::new()
            .name(format!("lease-{id}"))
            .spawn(move || Worker::run(grant, &*host, shared, desk, &receiver))
            .map_err(|error| ErrorReply::new(ErrorCode::Internal, "", format!("no thread for the lease: {error}")))?;
        tracing::info!(lease = id, client = request.client, num_envs, "lease granted");
        let route = WorkerHandle { jobs: sender, last_request: RwLock::new(Instant::now()) };
        self.routes.write().unwrap_or_else(std::sync::PoisonError::into_inner).insert(id.to_owned(), route);
        let absent_since = (!self.live_clients.contains(&request.client)).then(Instant::now);
        let lease = Lease { client: request.client.clone(), num_envs, epoch: 1, disconnected_since: absent_since, thread };
        self.leases.insert(id.to_owned(), lease);
        Ok(())
    }

    fn reclaim(&mut self, client: &str, reclaim: &message::Reclaim, query: &Query) -> Result<(), ErrorReply> {
        let Some(lease) = self.leases.get(&reclaim.lease) else {
            let message = format!("there is no lease `{}`: it was closed or its grace passed", reclaim.lease);
            return Err(ErrorReply::new(ErrorCode::LeaseLost, "reclaim.lease", message).with_hint("ask for a new lease"));
        };
        let epoch = lease.epoch;
        // Its reply was lost: tell the new owner again.
        let repeated = lease.client == client && reclaim.epoch == epoch - 1;
        if !repeated && reclaim.epoch != epoch {
            return Err(stale_epoch("reclaim.epoch", reclaim.epoch, epoch));
        }
        let epoch = if repeated { epoch } else { epoch + 1 };
        self.forward(&reclaim.lease, WorkerRequest::Lease { query: query.clone(), epoch })?;
        let absent_since = (!self.live_clients.contains(client)).then(Instant::now);
        if let Some(lease) = self.leases.get_mut(&reclaim.lease) {
            (lease.client, lease.epoch, lease.disconnected_since) = (client.to_owned(), epoch, absent_since);
        }
        Ok(())
    }

    fn forward(&self, lease: &str, job: WorkerRequest) -> Result<(), ErrorReply> {
        let routes = self.routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
        let sent = routes.get(lease).is_some_and(|route| route.jobs.try_send(job).is_ok());
        if sent { Ok(()) } else { Err(ErrorReply::new(ErrorCode::Busy, "", "the lease is busy")) }
    }

    fn update_liveliness(&mut self, client: String, present: bool) {
        for (id, lease) in self.leases.iter_mut().filter(|(_, lease)| lease.client == client) {
            tracing::info!(lease = id, client, present, "client seen or lost");
            lease.disconnected_since = (!present).then(Instant::now);
        }
        if present {
            self.live_clients.insert(client);
        } else {
            self.live_clients.remove(&client);
        }
    }

    fn expire_leases(&mut self) {
        let grace = self.facts.lease_grace;
        let lost: Vec<String> = {
            let routes = self.routes.read().unwrap_or_else(std::sync::PoisonError::into_inner);
            let silent = |id: &String| {
                routes.get(id).is_none_or(|route| {
                    route.last_request.read().unwrap_or_else(std::sync::PoisonError::into_inner).elapsed() > grace
                })
            };
            let absent = |lease: &Lease| lease.disconnected_since.is_some_and(|since| since.elapsed() > grace);
            self.leases.iter().filter(|(id, lease)| absent(lease) && silent(id)).map(|(id, _)| id.clone()).collect()
        };
        for id in lost {
            self.release(&id, "its client was lost and the grace has passed");
        }
    }

    /// Forgets a lease; its worker ends after the request in progress.
    fn release(&mut self, lease: &str, reason: &str) {
        if self.leases.remove(lease).is_some() {
            tracing::info!(lease, reason, "lease freed");
        }
        self.routes.write().unwrap_or_else(std::sync::PoisonError::into_inner).remove(lease);
    }
}
