//! The lease manager: answers `hello`, grants leases, monitors the liveliness of clients, releases expired leases.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use twinstep_model::EnvSpec;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, Secret, convert, decode, encode, message, random_id};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::EnvFactory;
use crate::dispatch::{Route, Routes, attached_secret, no_such_lease};
use crate::executor::{Executor, Handled, Handler, Mailbox, SendLock, lock};
use crate::messages::{LeaseParams, MAX_POLICY_BYTES, Reply, Request, RequestKind, ServerState};
use crate::worker::{Worker, stale_epoch};

/// Size of the repeated requests that may wait in the mailbox of a lease, besides one request of the largest size [bytes].
const MAX_REPEATS_BYTES: usize = 32 << 10;

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
    /// Maximum number of environments of one client id.
    pub max_envs_per_client: usize,
    /// Maximum size of a request [bytes].
    pub max_request_bytes: usize,
    /// Time for which the environments of a disconnected client are kept.
    pub lease_grace: Duration,
    /// Time without a request after which a lease is released; `None` for never.
    pub lease_idle: Option<Duration>,
    /// Port of the stop listener.
    pub stop_port: Option<u16>,
}

/// Grants leases and releases those of disconnected or idle clients.
pub struct LeaseManager {
    info: ServerInfo,
    factory: Arc<dyn EnvFactory>,
    state: Arc<ServerState>,
    routes: Routes,
    executor: Executor,
    leases: Mutex<Leases>,
}

#[derive(Default)]
struct Leases {
    by_id: HashMap<String, Lease>,
    /// Clients whose liveliness token is visible.
    live_clients: HashSet<String>,
}

struct Lease {
    client: String,
    secret: Secret,
    num_envs: usize,
    /// Fencing token, increased by one at each reclaim; sent to the worker.
    epoch: u64,
    /// Time at which the client's token disappeared; `None` while it is visible.
    disconnected_since: Option<Instant>,
}

/// Answers `hello` and `lease` requests.
pub struct LeaseHandler(pub Arc<LeaseManager>);

impl Handler for LeaseHandler {
    fn handle(&mut self, kind: &RequestKind, query: &Query) -> Handled {
        match kind {
            RequestKind::Hello => Handled::Reply(self.0.hello(query).into()),
            // The lease itself replies.
            _ => self.0.lease(query).err().map_or(Handled::Forwarded, |error| Handled::Reply(Reply::Err(error))),
        }
    }
}

impl LeaseManager {
    /// Creates a lease manager without leases.
    pub fn new(
        info: ServerInfo,
        factory: Arc<dyn EnvFactory>,
        state: Arc<ServerState>,
        routes: Routes,
        executor: Executor,
    ) -> Self {
        Self { info, factory, state, routes, executor, leases: Mutex::default() }
    }

    /// Returns the ids of the clients that have a lease.
    pub fn clients(&self) -> Vec<String> {
        lock(&self.leases).by_id.values().map(|lease| lease.client.clone()).collect()
    }

    fn hello(&self, query: &Query) -> Result<Vec<u8>, ErrorReply> {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        // A client of any version gets a reply, which contains the supported versions.
        if let Err(error) = decode::<message::HelloRequest>(&payload)
            && error.code != ErrorCode::Version
        {
            return Err(error);
        }
        let info = &self.info;
        Ok(encode(&message::HelloReply {
            protocol: PROTOCOL,
            protocols: [PROTOCOL, PROTOCOL],
            server_version: concat!("twinstep ", env!("CARGO_PKG_VERSION")).to_owned(),
            name: info.name.clone(),
            server_id: info.sid.clone(),
            spec_hash: info.spec.hash(),
            spec: info.spec.clone(),
            max_envs: info.max_envs as u64,
            free_envs: self.free_envs(&lock(&self.leases)) as u64,
            max_envs_per_client: info.max_envs_per_client as u64,
            max_request_bytes: info.max_request_bytes as u64,
            lease_grace_s: info.lease_grace.as_secs_f64(),
            lease_idle_s: info.lease_idle.map(|idle| idle.as_secs_f64()),
            env_steps: self.state.env_steps.load(Ordering::Relaxed),
            max_rollout_steps: self.state.max_rollout_steps as u64,
            max_policy_bytes: if self.state.max_rollout_steps > 0 { MAX_POLICY_BYTES as u64 } else { 0 },
            real_time: self
                .factory
                .real_time()
                .map(|real_time| message::RealTime { stop_port: info.stop_port, ..real_time }),
        }))
    }

    fn free_envs(&self, leases: &Leases) -> usize {
        self.info.max_envs - leases.by_id.values().map(|lease| lease.num_envs).sum::<usize>()
    }

    /// Forwards the request to the lease, which replies. Creates a new lease first if none is reclaimed.
    fn lease(self: &Arc<Self>, query: &Query) -> Result<(), ErrorReply> {
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let request: message::LeaseRequest = decode(&payload)?;
        self.check_lease_request(&request)?;
        let secret = attached_secret(query).ok_or_else(|| {
            ErrorReply::new(ErrorCode::Malformed, "secret", "the request has no secret: an attachment of 16 bytes")
                .with_hint("attach 16 random bytes to the lease request, and the same to every request for the lease")
        })?;
        let mut leases = lock(&self.leases);
        match &request.reclaim {
            Some(reclaim) => self.reclaim(&mut leases, &request.client, secret, reclaim, query),
            None => self.grant(&mut leases, &request, secret, query),
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

    fn grant(
        self: &Arc<Self>,
        leases: &mut Leases,
        request: &message::LeaseRequest,
        secret: Secret,
        query: &Query,
    ) -> Result<(), ErrorReply> {
        let held = leases.by_id.iter().find(|(_, lease)| lease.secret == secret);
        if let Some((id, lease)) = held {
            if lease.num_envs as u64 == request.num_envs && lease.client == request.client {
                return self.forward(id, query, lease.epoch);
            }
            let message = format!("the attached secret already has a lease of {} environments", lease.num_envs);
            return Err(ErrorReply::new(ErrorCode::OutOfRange, "secret", message)
                .with_hint("close that lease first, or attach another secret"));
        }
        self.check_num_envs(leases, request)?;
        let id = random_id();
        self.create(leases, &id, request, secret);
        self.forward(&id, query, 1)
    }

    fn check_num_envs(&self, leases: &Leases, request: &message::LeaseRequest) -> Result<(), ErrorReply> {
        let reject = |message: String, hint: &str| {
            Err(ErrorReply::new(ErrorCode::TooManyEnvs, "num_envs", message).with_hint(hint))
        };
        let (num_envs, max, free) = (request.num_envs, self.info.max_envs_per_client, self.free_envs(leases));
        let held = leases.by_id.values().filter(|lease| lease.client == request.client);
        let held: usize = held.map(|lease| lease.num_envs).sum();
        if num_envs > free as u64 {
            let message = format!("`num_envs` = {num_envs} is too large: {free} of {} are free", self.info.max_envs);
            return reject(message, "request fewer, or start the server with a larger `--envs`");
        }
        if num_envs.saturating_add(held as u64) > max as u64 {
            let message = format!("`num_envs` = {num_envs} is too large: a client may lease {max} in all");
            return reject(message, "close other leases, or start the server with a larger `max_envs_per_client`");
        }
        Ok(())
    }

    /// Creates a lease. Its environments are built by its first request.
    fn create(self: &Arc<Self>, leases: &mut Leases, id: &str, request: &message::LeaseRequest, secret: Secret) {
        let num_envs = request.num_envs as usize;
        let params = LeaseParams {
            lease: id.to_owned(),
            num_envs,
            autoreset: request.autoreset,
            max_episode_steps: request.max_episode_steps,
            critic: request.critic,
        };
        tracing::info!(lease = id, client = request.client, num_envs, "lease granted");
        let (manager, lease) = (Arc::clone(self), id.to_owned());
        let release = Box::new(move |reason: &str| manager.release(&lease, reason));
        let worker = Worker::new(params, Arc::clone(&self.factory), Arc::clone(&self.state), release);
        let max_request_bytes = convert::max_request_bytes(num_envs, &self.info.spec);
        let route = Route {
            secret,
            max_request_bytes,
            // A client has one request in progress, and may repeat it.
            mailbox: Mailbox::new(
                &self.executor,
                &request.client,
                SendLock::default(),
                max_request_bytes + MAX_REPEATS_BYTES,
                worker,
            ),
            last_request: Mutex::new(Instant::now()),
        };
        self.routes.write().unwrap_or_else(PoisonError::into_inner).insert(id.to_owned(), Arc::new(route));
        let disconnected_since = (!leases.live_clients.contains(&request.client)).then(Instant::now);
        let lease = Lease { client: request.client.clone(), secret, num_envs, epoch: 1, disconnected_since };
        leases.by_id.insert(id.to_owned(), lease);
    }

    fn reclaim(
        &self,
        leases: &mut Leases,
        client: &str,
        secret: Secret,
        reclaim: &message::Reclaim,
        query: &Query,
    ) -> Result<(), ErrorReply> {
        let is_live = leases.live_clients.contains(client);
        let lease = leases.by_id.get_mut(&reclaim.lease).filter(|lease| lease.secret == secret);
        let lease = lease.ok_or_else(|| no_such_lease(&reclaim.lease))?;
        // The reply to the new owner was lost: repeat it with the same epoch.
        let is_repeated = lease.client == client && reclaim.epoch == lease.epoch - 1;
        if !is_repeated && reclaim.epoch != lease.epoch {
            return Err(stale_epoch("reclaim.epoch", reclaim.epoch, lease.epoch));
        }
        let epoch = if is_repeated { lease.epoch } else { lease.epoch + 1 };
        self.forward(&reclaim.lease, query, epoch)?;
        (lease.client, lease.epoch) = (client.to_owned(), epoch);
        lease.disconnected_since = (!is_live).then(Instant::now);
        Ok(())
    }

    fn forward(&self, lease: &str, query: &Query, epoch: u64) -> Result<(), ErrorReply> {
        let routes = self.routes.read().unwrap_or_else(PoisonError::into_inner);
        let request = Request { query: query.clone(), kind: RequestKind::Granted { epoch } };
        let is_sent = routes.get(lease).is_some_and(|route| route.mailbox.push(request).is_ok());
        if is_sent { Ok(()) } else { Err(ErrorReply::new(ErrorCode::Busy, "", "the mailbox of this lease is full")) }
    }

    /// Records that the liveliness token of a client appeared or disappeared.
    pub fn update_liveliness(&self, client: &str, present: bool) {
        let mut leases = lock(&self.leases);
        for (id, lease) in leases.by_id.iter_mut().filter(|(_, lease)| lease.client == client) {
            tracing::info!(lease = id, client, present, "client liveliness changed");
            lease.disconnected_since = (!present).then(Instant::now);
        }
        if present {
            leases.live_clients.insert(client.to_owned());
        } else {
            leases.live_clients.remove(client);
        }
    }

    /// Releases the leases of clients that are disconnected for the grace period, and leases that are idle too long.
    pub fn expire_leases(&self) {
        let mut leases = lock(&self.leases);
        let routes = self.routes.read().unwrap_or_else(PoisonError::into_inner);
        let unused = |id: &String| match routes.get(id) {
            Some(route) if route.mailbox.is_busy() => Duration::ZERO,
            Some(route) => lock(&route.last_request).elapsed(),
            None => Duration::MAX,
        };
        let expired: Vec<(String, &str)> = leases
            .by_id
            .iter()
            .filter_map(|(id, lease)| {
                let disconnected = lease.disconnected_since.map_or(Duration::ZERO, |since| since.elapsed());
                if disconnected.min(unused(id)) > self.info.lease_grace {
                    Some((id.clone(), "its client is disconnected and the grace period has passed"))
                } else {
                    let is_idle = self.info.lease_idle.is_some_and(|idle| unused(id) > idle);
                    is_idle.then(|| (id.clone(), "it is idle"))
                }
            })
            .collect();
        drop(routes);
        let released: Vec<_> = expired.iter().map(|(id, reason)| self.remove(&mut leases, id, reason)).collect();
        // Environments may take seconds to end, and others wait for the lock of the leases.
        drop(leases);
        drop(released);
    }

    /// Releases a lease. Requests that are in its mailbox are still answered.
    pub fn release(&self, lease: &str, reason: &str) {
        let released = self.remove(&mut lock(&self.leases), lease, reason);
        drop(released);
    }

    /// Removes a lease. The environments end when what is returned is dropped.
    fn remove(&self, leases: &mut Leases, lease: &str, reason: &str) -> Option<Arc<Route>> {
        if leases.by_id.remove(lease).is_some() {
            tracing::info!(lease, reason, "lease released");
        }
        self.routes.write().unwrap_or_else(PoisonError::into_inner).remove(lease)
    }
}
