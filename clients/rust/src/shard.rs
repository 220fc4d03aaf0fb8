//! Neighbouring environments of a sharded batch, on one server.

use std::ops::Range;
use std::time::{Duration, Instant};

use twinstep_model::{EnvError, EnvSpec, ResetRequest, StepBatch, VecEnv};

use crate::recovery::{CHECK_PERIOD, LOSS_TIMEOUT, Recovery, is_timeout};
use crate::{ClientError, ConnectOptions, RemoteVecEnv};

/// Timeout of connecting to one server during a recovery. Another one may be waiting to be tried.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(1);
/// A server is waited for at least this long after another one was lost: until its request was repeated once.
const MIN_WAIT: Duration = Duration::from_secs(4);

/// Neighbouring environments on one server.
pub struct Shard {
    /// The environments.
    pub rows: Range<usize>,
    /// Options of all servers, the first one's first.
    servers: Vec<ConnectOptions>,
    state: State,
}

enum State {
    Leased(Box<RemoteVecEnv>),
    Lost(Recovery),
    /// The search for a new lease could not be started, or the shard is closed.
    None,
}

impl Shard {
    /// Leases `rows` at the first of `servers`.
    pub fn connect(rows: Range<usize>, mut servers: Vec<ConnectOptions>) -> Result<Self, ClientError> {
        for options in &mut servers {
            options.num_envs = rows.len();
        }
        let env = RemoteVecEnv::connect(&servers[0])?;
        for options in &mut servers {
            options.spec_hash = Some(env.spec().hash());
            options.connect_timeout = options.connect_timeout.min(RECOVERY_TIMEOUT);
        }
        Ok(Self { rows, servers, state: State::Leased(Box::new(env)) })
    }

    /// Returns the endpoint at which the environments were leased first.
    pub fn endpoint(&self) -> &str {
        &self.servers[0].endpoint
    }

    /// Returns the environments, unless their server is lost.
    pub fn env(&self) -> Option<&RemoteVecEnv> {
        match &self.state {
            State::Leased(env) => Some(env),
            _ => None,
        }
    }

    /// As [`Shard::env`], mutable.
    pub fn env_mut(&mut self) -> Option<&mut RemoteVecEnv> {
        match &mut self.state {
            State::Leased(env) => Some(env),
            _ => None,
        }
    }

    /// Waits for the reply to the step that was sent at `sent`. An error means that the server is lost.
    ///
    /// Returns `None` if no step is in progress.
    pub fn receive(&mut self, sent: Instant) -> Result<Option<&StepBatch>, EnvError> {
        let timeout = self.servers[0].timeout;
        let State::Leased(env) = &mut self.state else { return Ok(None) };
        if !env.is_pending() {
            return Ok(None);
        }
        let since = Instant::now();
        while let Err(error) = env.recv_within(CHECK_PERIOD) {
            let may_be_late = sent.elapsed() < timeout || since.elapsed() < timeout.min(MIN_WAIT);
            let may_be_there = since.elapsed() < LOSS_TIMEOUT || env.server_is_visible();
            if !is_timeout(&error) || !may_be_late || !may_be_there {
                return Err(error);
            }
        }
        Ok(Some(env.last_step()))
    }

    /// Starts new episodes in the rows that are true in `chosen`: with their seed where it is unused, else with their
    /// own random streams.
    pub fn reset(&mut self, chosen: &[bool], seeds: &[u64], is_unused: &[bool]) -> Result<(), EnvError> {
        let State::Leased(env) = &mut self.state else { return Ok(()) };
        for is_seeded in [true, false] {
            let mask: Vec<bool> = (0..chosen.len()).map(|row| chosen[row] && is_unused[row] == is_seeded).collect();
            if mask.contains(&true) {
                let seeds = is_seeded.then(|| seeds.to_vec());
                let mask = mask.contains(&false).then_some(mask);
                env.reset(&ResetRequest { seeds, mask })?;
            }
        }
        Ok(())
    }

    /// Starts to search for a new lease at all servers, in place of the present one.
    pub fn lose(&mut self) -> Result<(), EnvError> {
        if let State::Leased(env) = std::mem::replace(&mut self.state, State::None) {
            self.state = State::Lost(Recovery::start(self.servers.clone(), *env)?);
        }
        Ok(())
    }

    /// Takes the new lease, if one has been granted with the same spec. Returns false if there is none.
    pub fn take_over(&mut self, spec: &EnvSpec) -> Result<bool, EnvError> {
        let State::Lost(recovery) = &self.state else { return Ok(false) };
        let Some(env) = recovery.take() else { return Ok(false) };
        if env.spec() != spec {
            // Another server was started at the endpoint.
            tracing::warn!(endpoint = self.endpoint(), "a server with another spec is not used");
            self.state = State::Lost(Recovery::start(self.servers.clone(), env)?);
            return Ok(false);
        }
        self.state = State::Leased(Box::new(env));
        Ok(true)
    }

    /// Ends the lease at once.
    pub fn close(self) -> Result<(), ClientError> {
        match self.state {
            State::Leased(env) => env.close(),
            _ => Ok(()),
        }
    }
}
