//! A vector environment at the other end of Zenoh.

use std::sync::OnceLock;

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, Scene, StepBatch, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::{ErrorCode, PROTOCOL, ErrorReply, convert, decode, encode, keys, message, tensor};
use zenoh::bytes::ZBytes;
use zenoh::query::Querier;

use crate::link::{Pending, read_answer, send};
use crate::{ClientError, ConnectOptions, Connection};

/// What it takes to take a lease over from another process: keep it where a crash does not lose it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeaseHandle {
    /// The lease's id.
    pub lease: String,
    /// Its epoch.
    pub epoch: u64,
}

/// Environments on a server, for this client alone.
pub struct RemoteVecEnv {
    link: Connection,
    ticket: LeaseHandle,
    spec: EnvSpec,
    num_envs: usize,
    autoreset: AutoresetMode,
    last_seq: u64,
    step: Querier<'static>,
    reset: Querier<'static>,
    /// Declared with the first picture: an agent that draws none pays nothing.
    render: OnceLock<Querier<'static>>,
    /// The request under way, with its verb.
    pending: Option<(EnvMethod, Pending)>,
    batch: StepBatch,
}

impl RemoteVecEnv {
    /// Leases environments of the server at `options.endpoint`.
    pub fn connect(options: &ConnectOptions) -> Result<Self, ClientError> {
        Self::open(options, None)
    }

    /// Takes over a lease whose client is lost, within the server's grace. The environments are as they were left.
    pub fn reclaim(options: &ConnectOptions, ticket: &LeaseHandle) -> Result<Self, ClientError> {
        Self::open(options, Some(ticket))
    }

    fn open(options: &ConnectOptions, ticket: Option<&LeaseHandle>) -> Result<Self, ClientError> {
        let link = Connection::open(options)?;
        link.hello()?;
        let request = message::LeaseRequest {
            protocol: PROTOCOL,
            client: link.client().to_owned(),
            num_envs: options.num_envs as u64,
            autoreset: options.autoreset,
            max_episode_steps: options.max_episode_steps,
            spec_hash: options.spec_hash.clone(),
            reclaim: ticket.map(|ticket| message::Reclaim { lease: ticket.lease.clone(), epoch: ticket.epoch }),
        };
        let querier = link.querier(keys::lease(link.sid()))?;
        let answer = link.request(&querier, encode(&request))?;
        let granted: message::LeaseReply = read_answer(&answer, "lease")?;
        let key = |verb| keys::env(link.sid(), &granted.lease, verb);
        let (step, reset) = (link.querier(key(EnvMethod::Step))?, link.querier(key(EnvMethod::Reset))?);
        let num_envs = granted.num_envs as usize;
        Ok(Self {
            batch: StepBatch::new(num_envs, granted.spec.obs_len()),
            ticket: LeaseHandle { lease: granted.lease, epoch: granted.epoch },
            spec: granted.spec,
            num_envs,
            autoreset: granted.autoreset,
            last_seq: granted.last_seq,
            step,
            reset,
            render: OnceLock::new(),
            pending: None,
            link,
        })
    }

    /// What it takes to take this lease over from another process.
    pub fn ticket(&self) -> &LeaseHandle {
        &self.ticket
    }

    /// Sends actions without waiting: the policy may compute while the server steps. [`RemoteVecEnv::recv`] is next.
    pub fn send(&mut self, actions: &[f32]) -> Result<(), EnvError> {
        if let Some((verb, _)) = &self.pending {
            return Err(remote(ClientError::RequestPending(verb.name())));
        }
        let wanted = self.num_envs * self.spec.action_len();
        if actions.len() != wanted {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), wanted });
        }
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        let request = convert::encode_actions(actions, epoch, seq);
        self.pending = Some((EnvMethod::Step, send(&self.step, request).map_err(remote)?));
        Ok(())
    }

    /// Waits for what the sent actions gave. After a [`ClientError::NoAnswer`] it may be called again: the step is then
    /// repeated under its number, and still executed once.
    pub fn recv(&mut self) -> Result<&StepBatch, EnvError> {
        match &self.pending {
            Some((EnvMethod::Step, _)) => {}
            Some((verb, _)) => return Err(remote(ClientError::RequestPending(verb.name()))),
            None => return Err(remote(ClientError::NothingSent)),
        }
        let answer = self.await_pending()?;
        let bytes = answer.to_bytes();
        let reply: message::StepReply<'_> = decode(&bytes).map_err(|error| malformed("step", error))?;
        convert::decode_step(&reply, &self.spec, self.num_envs, &mut self.batch)
            .map_err(|error| malformed("step", error))?;
        Ok(&self.batch)
    }

    /// Gives the environments back at once, in place of leaving them to the server's grace.
    pub fn close(mut self) -> Result<(), ClientError> {
        if self.pending.is_some() {
            // What it gave no longer matters, but its number must be settled.
            let _ = self.await_pending();
        }
        let querier = self.link.querier(keys::env(self.link.sid(), &self.ticket.lease, EnvMethod::Close))?;
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        match self.link.request(&querier, encode(&message::CloseRequest { protocol: PROTOCOL, epoch, seq })) {
            // The first answer was lost, or the grace has passed: they are free either way.
            Err(ClientError::Rejected(refusal)) if refusal.code == ErrorCode::LeaseLost => Ok(()),
            answer => answer.map(drop),
        }
    }

    fn render_querier(&self) -> Result<&Querier<'static>, ClientError> {
        if let Some(querier) = self.render.get() {
            return Ok(querier);
        }
        let querier = self.link.querier(keys::env(self.link.sid(), &self.ticket.lease, EnvMethod::Render))?;
        Ok(self.render.get_or_init(|| querier))
    }

    /// Waits for the answer to the pending request. Without an answer it stays pending, because it may have been
    /// executed; its number is used up by an answer, or by an error that had effects.
    fn await_pending(&mut self) -> Result<ZBytes, EnvError> {
        let Some((verb, pending)) = &mut self.pending else { return Err(remote(ClientError::NothingSent)) };
        let querier = if *verb == EnvMethod::Reset { &self.reset } else { &self.step };
        let answer = self.link.wait_reply(querier, pending);
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
            // A step that was given up: what it gave or why it was refused no longer matters, whether it was executed does.
            let settled = self.await_pending().map(drop);
            if self.pending.is_some() {
                return settled.map(|()| self.batch.obs.as_slice());
            }
        }
        request.check(self.num_envs)?;
        let payload = convert::encode_reset(request, self.ticket.epoch, self.last_seq + 1);
        self.pending = Some((EnvMethod::Reset, send(&self.reset, payload).map_err(remote)?));
        let answer = self.await_pending()?;
        let bytes = answer.to_bytes();
        let reply: message::ResetReply<'_> = decode(&bytes).map_err(|error| malformed("reset", error))?;
        tensor::read_into(reply.obs, &mut self.batch.obs, "obs").map_err(|error| malformed("reset", error))?;
        convert::check_length("obs", self.batch.obs.len(), self.num_envs * self.spec.obs_len())
            .map_err(|error| malformed("reset", error))?;
        Ok(&self.batch.obs)
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.send(actions)?;
        self.recv()
    }

    /// While a step is under way, it is drawn after the step.
    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let querier = self.render_querier().map_err(remote)?;
        let request = message::RenderRequest { protocol: PROTOCOL, epoch: self.ticket.epoch, env: env as u64 };
        let answer = self.link.request(querier, encode(&request)).map_err(remote)?;
        let bytes = answer.to_bytes();
        decode(&bytes).and_then(convert::decode_scene).map_err(|error| malformed("render", error))
    }
}

fn remote(error: ClientError) -> EnvError {
    EnvError::Remote(Box::new(error))
}

fn malformed(request: &str, error: ErrorReply) -> EnvError {
    remote(ClientError::Malformed { request: request.to_owned(), reason: error.message })
}
