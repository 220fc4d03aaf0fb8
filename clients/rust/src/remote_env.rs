//! Vectorised environments on a server.

use std::time::Duration;

use twinstep_model::{
    AgentCommands, AutoresetMode, EnvError, EnvSpec, GaitCommand, RealTimeReport, ResetRequest, RobotSample, Scene,
    StepBatch, Trajectory, VecEnv, VelocityCommand,
};
use twinstep_policy::BehaviourPolicy;
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::tensor::as_bytes;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, Secret, convert, decode, encode, keys, message};
use zenoh::bytes::ZBytes;

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
    /// Number of steps of the rollout in progress, and the fingerprint of its policy if the request contains it.
    sent_rollout: (usize, Option<u64>),
    /// Fingerprint of the policy that the server holds, and its id.
    held_policy: Option<(u64, u64)>,
    /// The request in progress, with its method.
    pending: Option<(EnvMethod, Pending)>,
    /// True if a reply could not be read, so that the state of the environments is unknown. A reset heals it.
    is_unknown: bool,
    /// Commands, which every step request repeats.
    commands: AgentCommands,
    /// Policy period of the next actions, if the agent has set it.
    action_tick: Option<u64>,
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
        let mut connection = Connection::open(options, secret)?;
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
        let answer = connection.request(&keys::lease(connection.sid()), encode(&request))?;
        let granted: message::LeaseReply = read_answer(&answer, "lease")?;
        connection.declare(keys::env(connection.sid(), &granted.lease, EnvMethod::Step))?;
        let num_envs = convert::check_lease(granted.num_envs, &granted.spec)
            .map_err(|error| ClientError::Malformed { request: "lease".to_owned(), reason: error.message })?;
        Ok(Self {
            batch: StepBatch::new(num_envs, &granted.spec),
            ticket: LeaseHandle { lease: granted.lease, epoch: granted.epoch, secret },
            spec: granted.spec,
            num_envs,
            autoreset: granted.autoreset,
            last_seq: granted.last_seq,
            sent_rollout: (0, None),
            held_policy: None,
            pending: None,
            is_unknown: false,
            commands: AgentCommands::default(),
            action_tick: None,
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
        self.check_idle()?;
        let expected = self.num_envs * self.spec.action_len();
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        let for_tick = self.action_tick.take();
        let request = convert::encode_actions(actions, &self.commands, for_tick, epoch, seq);
        self.send_request(EnvMethod::Step, request)?;
        Ok(())
    }

    /// Waits for the result of the actions that were sent.
    ///
    /// It may be called again after a [`ClientError::RequestTimeout`]. The step is then repeated with the same sequence
    /// number, and executed once.
    pub fn recv(&mut self) -> Result<&StepBatch, EnvError> {
        self.recv_within(self.connection.timeout())?;
        Ok(&self.batch)
    }

    /// As [`RemoteVecEnv::recv`], with another timeout. [`RemoteVecEnv::last_step`] is then the result.
    pub fn recv_within(&mut self, timeout: Duration) -> Result<(), EnvError> {
        self.check_pending(EnvMethod::Step)?;
        let answer = self.await_pending(timeout)?;
        let bytes = answer.to_bytes();
        self.is_unknown = true;
        let reply: message::StepReply<'_> = decode(&bytes).map_err(|error| malformed("step", error))?;
        check_seq("step", reply.seq, self.last_seq)?;
        convert::decode_step(&reply, &self.spec, self.num_envs, &mut self.batch)
            .map_err(|error| malformed("step", error))?;
        self.is_unknown = false;
        Ok(())
    }

    /// Returns the result of the last step.
    pub fn last_step(&self) -> &StepBatch {
        &self.batch
    }

    /// Returns true if the server fronts a robot, whose steps take one policy period of real time.
    pub fn is_real_time(&self) -> bool {
        self.connection.is_real_time()
    }

    /// Stops the robot at once: its motors are damped until its operator arms them again.
    pub fn stop(&self) -> Result<(), ClientError> {
        self.connection.stop_robot()
    }

    /// Returns the maximum number of steps of a rollout; 0 for a server without rollouts.
    pub fn max_rollout_steps(&self) -> u64 {
        self.connection.max_rollout_steps()
    }

    /// Runs `policy` on the server for `steps` steps of all environments.
    ///
    /// The noise of environment `i` is a function of `noise_seed + i` alone. The weights are sent only if they differ
    /// from those of the last rollout. Sends the request and waits, as [`RemoteVecEnv::send_rollout`] and
    /// [`RemoteVecEnv::recv_rollout`] do.
    pub fn rollout(
        &mut self,
        policy: &BehaviourPolicy,
        noise_seed: u64,
        steps: usize,
        trajectory: &mut Trajectory,
    ) -> Result<(), EnvError> {
        self.send_rollout(policy, noise_seed, steps)?;
        let result = self.recv_rollout(trajectory);
        if !result.as_ref().is_err_and(is_unknown_policy) {
            return result;
        }
        self.send_rollout(policy, noise_seed, steps)?;
        self.recv_rollout(trajectory)
    }

    /// Sends the request for a rollout without waiting. Call [`RemoteVecEnv::recv_rollout`] next.
    pub fn send_rollout(&mut self, policy: &BehaviourPolicy, noise_seed: u64, steps: usize) -> Result<(), EnvError> {
        self.check_idle()?;
        let fingerprint = policy.fingerprint();
        let policy_id = self.held_policy.filter(|(held, _)| *held == fingerprint).map(|(_, id)| id);
        let (mean, std) = policy.normaliser().mean_and_std();
        let sent = message::RolloutPolicy {
            sizes: policy.actor().sizes().iter().map(|size| *size as u64).collect(),
            weights: as_bytes(policy.weights()),
            mean: as_bytes(&mean),
            std: as_bytes(&std),
            log_std: as_bytes(policy.log_std()),
        };
        let request = message::RolloutRequest {
            protocol: PROTOCOL,
            epoch: self.ticket.epoch,
            seq: self.last_seq + 1,
            steps: steps as u64,
            noise_seed,
            policy: policy_id.is_none().then_some(sent),
            policy_id,
        };
        self.send_request(EnvMethod::Rollout, encode(&request))?;
        self.sent_rollout = (steps, policy_id.is_none().then_some(fingerprint));
        Ok(())
    }

    /// Waits for the trajectory of a rollout.
    ///
    /// It may be called again after a [`ClientError::RequestTimeout`]. After
    /// [`ErrorCode::UnknownPolicy`](twinstep_protocol::ErrorCode::UnknownPolicy) the next request contains the policy.
    pub fn recv_rollout(&mut self, trajectory: &mut Trajectory) -> Result<(), EnvError> {
        self.recv_rollout_within(self.connection.timeout(), trajectory)
    }

    /// As [`RemoteVecEnv::recv_rollout`], with another timeout.
    pub fn recv_rollout_within(&mut self, timeout: Duration, trajectory: &mut Trajectory) -> Result<(), EnvError> {
        self.check_pending(EnvMethod::Rollout)?;
        let answer = self.await_pending(timeout).inspect_err(|error| {
            if is_unknown_policy(error) {
                self.held_policy = None;
            }
            // The steps before the failed one were executed.
            self.is_unknown |= is_rejected_with(error, ErrorCode::RolloutFailed);
        })?;
        let bytes = answer.to_bytes();
        self.is_unknown = true;
        let reply: message::RolloutReply<'_> = decode(&bytes).map_err(|error| malformed("rollout", error))?;
        check_seq("rollout", reply.seq, self.last_seq)?;
        let (steps, new_policy) = self.sent_rollout;
        convert::decode_trajectory(&reply, &self.spec, self.num_envs, steps, trajectory)
            .map_err(|error| malformed("rollout", error))?;
        if let Some(fingerprint) = new_policy {
            self.held_policy = Some((fingerprint, self.last_seq));
        }
        let last = |rows: &[f32], len: usize| rows[rows.len() - len..].to_vec();
        self.batch.obs = last(&trajectory.obs, self.batch.obs.len());
        self.batch.critic_obs = last(&trajectory.critic_obs, self.batch.critic_obs.len());
        self.is_unknown = false;
        Ok(())
    }

    /// Returns true if the server's liveliness token is visible.
    pub fn server_is_visible(&self) -> bool {
        self.connection.server_is_visible()
    }

    /// Returns true if a request is in progress.
    pub fn is_pending(&self) -> bool {
        self.pending.is_some()
    }

    /// Ends the lease at once. Without it, the server keeps the environments for the grace period.
    pub fn close(mut self) -> Result<(), ClientError> {
        if self.pending.is_some() {
            // Its result is not needed, but whether its number was consumed is.
            let _ = self.await_pending(self.connection.timeout());
        }
        let (epoch, seq) = (self.ticket.epoch, self.last_seq + 1);
        let request = encode(&message::CloseRequest { protocol: PROTOCOL, epoch, seq });
        match self.connection.request(&self.key(EnvMethod::Close), request) {
            // The first reply was lost, or the grace period has passed: the lease has ended either way.
            Err(ClientError::Rejected(refusal)) if refusal.code == ErrorCode::LeaseLost => Ok(()),
            answer => answer.map(drop),
        }
    }

    /// Returns the key of a method of the lease.
    fn key(&self, method: EnvMethod) -> String {
        keys::env(self.connection.sid(), &self.ticket.lease, method)
    }

    /// Sends a request, which is in progress from now on.
    fn send_request(&mut self, method: EnvMethod, request: Vec<u8>) -> Result<(), EnvError> {
        self.pending = Some((method, self.connection.send(&self.key(method), request).map_err(remote)?));
        Ok(())
    }

    /// Fails if a request is in progress, or the state of the environments is unknown.
    fn check_idle(&self) -> Result<(), EnvError> {
        if let Some((verb, _)) = &self.pending {
            return Err(remote(ClientError::RequestPending(verb.name())));
        }
        if self.is_unknown { Err(remote(ClientError::UnknownState)) } else { Ok(()) }
    }

    /// Fails unless a request of this method is in progress.
    fn check_pending(&self, expected: EnvMethod) -> Result<(), EnvError> {
        match &self.pending {
            Some((verb, _)) if *verb == expected => Ok(()),
            Some((verb, _)) => Err(remote(ClientError::RequestPending(verb.name()))),
            None => Err(remote(ClientError::NothingSent)),
        }
    }

    /// Waits for the reply to the pending request.
    ///
    /// After a timeout the request stays pending, because it may have been executed. A reply or an error with effects
    /// consumes its number.
    fn await_pending(&mut self, timeout: Duration) -> Result<ZBytes, EnvError> {
        let Some((method, pending)) = &mut self.pending else { return Err(remote(ClientError::NothingSent)) };
        let key = keys::env(self.connection.sid(), &self.ticket.lease, *method);
        let answer = self.connection.wait_reply(&key, pending, timeout);
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
            let awaited = self.await_pending(self.connection.timeout()).map(drop);
            if self.pending.is_some() {
                return awaited.map(|()| self.batch.obs.as_slice());
            }
        }
        request.check(self.num_envs)?;
        let payload = convert::encode_reset(request, self.ticket.epoch, self.last_seq + 1);
        self.send_request(EnvMethod::Reset, payload)?;
        let answer = self.await_pending(self.connection.timeout())?;
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

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn critic_obs(&self) -> &[f32] {
        &self.batch.critic_obs
    }

    /// Every later step request contains the commands. A server that is older than the field ignores it.
    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.spec.check_velocity_commands(commands, self.num_envs)?;
        self.commands.velocity = Some(commands.to_vec());
        Ok(())
    }

    /// Every later step request contains the commands. A server that is older than the field ignores it.
    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.spec.check_gait_commands(commands, self.num_envs)?;
        self.commands.gait = Some(commands.to_vec());
        Ok(())
    }

    fn set_action_tick(&mut self, tick: u64) {
        self.action_tick = Some(tick);
    }

    fn real_time(&self) -> Option<&RealTimeReport> {
        self.batch.real_time.as_ref()
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.send(actions)?;
        self.recv()
    }

    /// If a step is in progress, the scene is that after the step.
    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let request = message::RenderRequest { protocol: PROTOCOL, epoch: self.ticket.epoch, env: env as u64 };
        let answer = self.connection.request(&self.key(EnvMethod::Render), encode(&request)).map_err(remote)?;
        let bytes = answer.to_bytes();
        decode(&bytes).and_then(convert::decode_scene).map_err(|error| malformed("render", error))
    }

    /// A server that is older than this request answers that the key is unknown.
    fn samples(&mut self, env: usize) -> Result<Vec<RobotSample>, EnvError> {
        let request = message::SamplesRequest { protocol: PROTOCOL, epoch: self.ticket.epoch, env: env as u64 };
        let answer = self.connection.request(&self.key(EnvMethod::Samples), encode(&request)).map_err(remote)?;
        let bytes = answer.to_bytes();
        decode(&bytes).and_then(convert::decode_samples).map_err(|error| malformed("samples", error))
    }
}

fn remote(error: ClientError) -> EnvError {
    EnvError::Remote(Box::new(error))
}

/// Returns the error of the client inside an error of its environments.
pub fn client_error(error: &EnvError) -> Option<&ClientError> {
    match error {
        EnvError::Remote(error) => error.downcast_ref(),
        _ => None,
    }
}

fn is_rejected_with(error: &EnvError, code: ErrorCode) -> bool {
    matches!(client_error(error), Some(ClientError::Rejected(rejection)) if rejection.code == code)
}

/// Returns true if the server does not hold the policy whose id was sent.
pub fn is_unknown_policy(error: &EnvError) -> bool {
    is_rejected_with(error, ErrorCode::UnknownPolicy)
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
