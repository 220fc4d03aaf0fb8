//! Vectorised environments on a server.

use std::sync::OnceLock;

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, Scene, StepBatch, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, Secret, convert, decode, encode, keys, message};
use zenoh::bytes::ZBytes;
use zenoh::query::Querier;

use crate::connection::{Pending, read_answer};
use crate::{ClientError, ConnectOptions, Connection};

/// Id, epoch and secret of a lease, with which another process can reclaim it. Store it where a crash does not lose it
/// and nobody else can read it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeaseHandle {
    /// Id of the lease.
    pub lease: String,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Secret of the lease. Whoever has it can use the environments.
    pub secret: Secret,
}

/// Environments on a server, leased by this client.
pub struct RemoteVecEnv {
    connection: Connection,
    ticket: LeaseHandle,
    spec: EnvSpec,
    num_envs: usize,
    autoreset: AutoresetMode,
    last_seq: u64,
    step: Querier<'static>,
    reset: Querier<'static>,
    /// Declared at the first `scene`, which most agents never request.
    render: OnceLock<Querier<'static>>,
    /// The request in progress, with its method.
    pending: Option<(EnvMethod, Pending)>,
    /// True if a reply could not be read, so that the state of the environments is unknown. A reset heals it.
    is_unknown: bool,
    /// Velocity commands, which every step request repeats.
    velocity_commands: Option<Vec<[f32; 3]>>,
    batch: StepBatch,
}

impl RemoteVecEnv {
    /// Leases environments of the server at `options.endpoint`.
    pub fn connect(options: &ConnectOptions) -> Result<Self, ClientError> {
        Self::open(options, None)
    }

    /// Reclaims the lease of another process within the server's grace period. The environments are unchanged.
    pub fn reclaim(options: &ConnectOptions, ticket: &LeaseHandle) -> Result<Self, ClientError> {
        Self::open(options, Some(ticket))
    }

    fn open(options: &ConnectOptions, ticket: Option<&LeaseHandle>) -> Result<Self, ClientError> {
        let secret = ticket.map_or_else(Secret::random, |ticket| ticket.secret);
        let connection = Connection::open(options, secret)?;
        let request = message::LeaseRequest {
            protocol: PROTOCOL,
            client: connection.client().to_owned(),
            num_envs: options.num_envs as u64,
            autoreset: options.autoreset,
            max_episode_steps: options.max_episode_steps,
            critic: options.critic,
            spec_hash: options.spec_hash.clone(),
            reclaim: ticket.map(|ticket| message::Reclaim { lease: ticket.lease.clone(), epoch: ticket.epoch }),
        };
        let querier = connection.querier(keys::lease(connection.sid()))?;
        let answer = connection.request(&querier, encode(&request))?;
        let granted: message::LeaseReply = read_answer(&answer, "lease")?;
        let key = |verb| keys::env(connection.sid(), &granted.lease, verb);
        let (step, reset) = (connection.querier(key(EnvMethod::Step))?, connection.querier(key(EnvMethod::Reset))?);
        let num_envs = convert::check_lease(granted.num_envs, &granted.spec)
            .map_err(|error| ClientError::Malformed { request: "lease".to_owned(), reason: error.message })?;
        Ok(Self {
            batch: StepBatch::new(num_envs, &granted.spec),
            ticket: LeaseHandle { lease: granted.lease, epoch: granted.epoch, secret },
            spec: granted.spec,
            num_envs,
            autoreset: granted.autoreset,
            last_seq: granted.last_seq,
            step,
            reset,
            render: OnceLock::new(),
            pending: None,
            is_unknown: false,
            velocity_commands: None,
            connection,
        })
    }

    /// Returns the id of the server.
    pub fn server_id(&self) -> &str {
        self.connection.sid()
    }

    /// Returns the handle with which another process can reclaim this lease.
    pub fn ticket(&self) -> &LeaseHandle {
        &self.ticket
    }

    /// Sends actions without waiting, so that the caller can compute during the step. Call [`RemoteVecEnv::recv`] next.
    pub fn send(&mut self, actions: &[f32]) -> Result<(), EnvError> {
        if let Some((verb, _)) = &self.pending {
            return Err(remote(ClientError::RequestPending(verb.name())));
        }
        if self.is_unknown {
            return Err(remote(ClientError::UnknownState));
        }
        let expected = self.num_envs * self.spec.action_len();
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        let request = convert::encode_actions(actions, self.velocity_commands.as_deref(), epoch, seq);
        self.pending = Some((EnvMethod::Step, self.connection.send(&self.step, request).map_err(remote)?));
        Ok(())
    }

    /// Waits for the result of the actions that were sent.
    ///
    /// It may be called again after a [`ClientError::RequestTimeout`]. The step is then repeated with the same sequence
    /// number, and executed once.
    pub fn recv(&mut self) -> Result<&StepBatch, EnvError> {
        match &self.pending {
            Some((EnvMethod::Step, _)) => {}
            Some((verb, _)) => return Err(remote(ClientError::RequestPending(verb.name()))),
            None => return Err(remote(ClientError::NothingSent)),
        }
        let answer = self.await_pending()?;
        let bytes = answer.to_bytes();
        self.is_unknown = true;
        let reply: message::StepReply<'_> = decode(&bytes).map_err(|error| malformed("step", error))?;
        check_seq("step", reply.seq, self.last_seq)?;
        convert::decode_step(&reply, &self.spec, self.num_envs, &mut self.batch)
            .map_err(|error| malformed("step", error))?;
        self.is_unknown = false;
        Ok(&self.batch)
    }

    /// Ends the lease at once. Without it, the server keeps the environments for the grace period.
    pub fn close(mut self) -> Result<(), ClientError> {
        if self.pending.is_some() {
            // Its result is not needed, but whether its number was consumed is.
            let _ = self.await_pending();
        }
        let querier =
            self.connection.querier(keys::env(self.connection.sid(), &self.ticket.lease, EnvMethod::Close))?;
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        match self.connection.request(&querier, encode(&message::CloseRequest { protocol: PROTOCOL, epoch, seq })) {
            // The first reply was lost, or the grace period has passed: the lease has ended either way.
            Err(ClientError::Rejected(refusal)) if refusal.code == ErrorCode::LeaseLost => Ok(()),
            answer => answer.map(drop),
        }
    }

    fn render_querier(&self) -> Result<&Querier<'static>, ClientError> {
        if let Some(querier) = self.render.get() {
            return Ok(querier);
        }
        let querier =
            self.connection.querier(keys::env(self.connection.sid(), &self.ticket.lease, EnvMethod::Render))?;
        Ok(self.render.get_or_init(|| querier))
    }

    /// Waits for the reply to the pending request.
    ///
    /// After a timeout the request stays pending, because it may have been executed. A reply or an error with effects
    /// consumes its number.
    fn await_pending(&mut self) -> Result<ZBytes, EnvError> {
        let Some((verb, pending)) = &mut self.pending else { return Err(remote(ClientError::NothingSent)) };
        let querier = if *verb == EnvMethod::Reset { &self.reset } else { &self.step };
        let answer = self.connection.wait_reply(querier, pending);
        let executed = match &answer {
            Ok(_) => true,
            Err(ClientError::RequestTimeout { .. }) => return answer.map_err(remote),
            Err(ClientError::Rejected(refusal)) => refusal.code.consumes_seq(),
            Err(_) => false,
        };
        self.pending = None;
        self.last_seq += u64::from(executed);
        answer.map_err(remote)
    }
}

impl VecEnv for RemoteVecEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.num_envs
    }

    fn autoreset(&self) -> AutoresetMode {
        self.autoreset
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        if self.pending.is_some() {
            // An abandoned step: its result or error is not needed, but whether its number was consumed is.
            let awaited = self.await_pending().map(drop);
            if self.pending.is_some() {
                return awaited.map(|()| self.batch.obs.as_slice());
            }
        }
        request.check(self.num_envs)?;
        let payload = convert::encode_reset(request, self.ticket.epoch, self.last_seq + 1);
        self.pending = Some((EnvMethod::Reset, self.connection.send(&self.reset, payload).map_err(remote)?));
        let answer = self.await_pending()?;
        let bytes = answer.to_bytes();
        let was_unknown = std::mem::replace(&mut self.is_unknown, true);
        let reply: message::ResetReply<'_> = decode(&bytes).map_err(|error| malformed("reset", error))?;
        check_seq("reset", reply.seq, self.last_seq)?;
        convert::decode_observations(&reply, &self.spec, self.num_envs, &mut self.batch)
            .map_err(|error| malformed("reset", error))?;
        // A mask leaves the other environments as they are.
        self.is_unknown = was_unknown && request.mask.is_some();
        Ok(&self.batch.obs)
    }

    fn critic_obs(&self) -> &[f32] {
        &self.batch.critic_obs
    }

    /// Every later step request contains the commands. A server that is older than the field ignores it.
    fn set_velocity_commands(&mut self, commands: &[[f32; 3]]) -> Result<(), EnvError> {
        self.spec.check_velocity_commands(commands, self.num_envs)?;
        self.velocity_commands = Some(commands.to_vec());
        Ok(())
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.send(actions)?;
        self.recv()
    }

    /// If a step is in progress, the scene is that after the step.
    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let querier = self.render_querier().map_err(remote)?;
        let request = message::RenderRequest { protocol: PROTOCOL, epoch: self.ticket.epoch, env: env as u64 };
        let answer = self.connection.request(querier, encode(&request)).map_err(remote)?;
        let bytes = answer.to_bytes();
        decode(&bytes).and_then(convert::decode_scene).map_err(|error| malformed("render", error))
    }
}

fn remote(error: ClientError) -> EnvError {
    EnvError::Remote(Box::new(error))
}

/// Fails if a reply is not that to the last request.
fn check_seq(request: &str, given: u64, expected: u64) -> Result<(), EnvError> {
    if given == expected {
        return Ok(());
    }
    let reason = format!("its `seq` is {given}, not {expected}");
    Err(remote(ClientError::Malformed { request: request.to_owned(), reason }))
}

fn malformed(request: &str, error: ErrorReply) -> EnvError {
    remote(ClientError::Malformed { request: request.to_owned(), reason: error.message })
}
