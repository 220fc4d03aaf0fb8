//! Robots of a server that collect trajectories for a learner, and are leased again after their server was lost.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use rand::Rng;
use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, Trajectory, VecEnv, stream};
use twinstep_policy::{BehaviourPolicy, Collector};
use twinstep_protocol::ErrorCode;

use crate::remote_env::{client_error, is_unknown_policy};
use crate::{ClientError, ConnectOptions, RemoteVecEnv};

/// Time without a reply and without a visible server after which the server is lost.
const LOSS_TIMEOUT: Duration = Duration::from_secs(3);
/// Time after which it is checked whether the server is visible.
const CHECK_PERIOD: Duration = Duration::from_millis(500);
/// Pause before the next attempt to lease robots.
const RETRY_PERIOD: Duration = Duration::from_millis(200);

/// Environments on a server that run the policy of a learner.
///
/// If the server is lost, [`Collector::collect`] returns false until a server at the same endpoint has granted a new
/// lease. The robots then start new episodes, with seeds that follow from those of the last reset.
pub struct RemoteCollector {
    options: ConnectOptions,
    spec: EnvSpec,
    state: LeaseState,
    seeds: Vec<u64>,
    /// Number of times that the server was lost.
    losses: u64,
    /// Time of the last request.
    sent: Instant,
}

enum LeaseState {
    Leased(Box<RemoteVecEnv>),
    /// A thread requests a new lease, and sends it. It ends when `_needed` is dropped.
    Lost {
        granted: Receiver<RemoteVecEnv>,
        _needed: Arc<()>,
    },
    Closed,
}

impl RemoteCollector {
    /// Creates a collector of environments that were leased with `options`.
    pub fn new(env: RemoteVecEnv, options: &ConnectOptions) -> Self {
        let spec = env.spec().clone();
        // The policy is trained for the robots of the first lease.
        let options = ConnectOptions { spec_hash: Some(spec.hash()), ..options.clone() };
        Self {
            options,
            spec,
            state: LeaseState::Leased(Box::new(env)),
            seeds: Vec::new(),
            losses: 0,
            sent: Instant::now(),
        }
    }

    /// Takes a new lease if it has been granted since the loss, and starts its episodes.
    fn take_new_lease(&mut self) -> Result<(), EnvError> {
        let LeaseState::Lost { granted, .. } = &self.state else { return Ok(()) };
        let Ok(mut env) = granted.try_recv() else { return Ok(()) };
        let losses = self.losses;
        let seeds = self.seeds.iter().map(|seed| stream(*seed, "lost server", losses).next_u64()).collect();
        let result = env.reset(&ResetRequest { seeds: Some(seeds), mask: None }).map(drop);
        self.state = LeaseState::Leased(Box::new(env));
        match result {
            Ok(()) => {
                let (endpoint, num_envs) = (&self.options.endpoint, self.options.num_envs);
                tracing::info!(endpoint, num_envs, "robots leased again");
                Ok(())
            }
            Err(error) => self.check_loss(error),
        }
    }

    /// Starts to request a new lease if `error` means that the server is lost. Otherwise returns the error.
    fn check_loss(&mut self, error: EnvError) -> Result<(), EnvError> {
        if !is_loss(&error) {
            return Err(error);
        }
        let (endpoint, num_envs) = (&self.options.endpoint, self.options.num_envs);
        tracing::warn!(endpoint, num_envs, %error, "robots lost, and left out until a server has leased them again");
        let (sender, granted) = channel();
        let (options, needed) = (self.options.clone(), Arc::new(()));
        let is_needed = Arc::downgrade(&needed);
        let thread = std::thread::Builder::new().name("lease".to_owned());
        thread
            .spawn(move || request_lease(&options, &is_needed, &sender))
            .map_err(|cause| EnvError::Remote(Box::new(cause)))?;
        // The old connection ends, so that its lease expires at a server that still runs.
        self.state = LeaseState::Lost { granted, _needed: needed };
        self.losses += 1;
        Ok(())
    }
}

impl Drop for RemoteCollector {
    /// Ends the lease, so that its robots are free at once.
    fn drop(&mut self) {
        if let LeaseState::Leased(env) = std::mem::replace(&mut self.state, LeaseState::Closed)
            && env.server_is_visible()
            && let Err(error) = env.close()
        {
            tracing::debug!(%error, "lease not closed");
        }
    }
}

/// Requests a lease until it is granted or not needed any more.
fn request_lease(options: &ConnectOptions, is_needed: &Weak<()>, granted: &Sender<RemoteVecEnv>) {
    while is_needed.strong_count() > 0 {
        match RemoteVecEnv::connect(options) {
            Ok(env) => return drop(granted.send(env)),
            Err(error) => tracing::debug!(endpoint = options.endpoint, %error, "no lease yet"),
        }
        std::thread::sleep(RETRY_PERIOD);
    }
}

/// Returns true if the error means that the lease does not exist any more, or that its server cannot be reached.
fn is_loss(error: &EnvError) -> bool {
    match client_error(error) {
        Some(ClientError::Restarted { .. } | ClientError::ShuttingDown { .. } | ClientError::RequestTimeout { .. }) => {
            true
        }
        Some(ClientError::Rejected(rejection)) => {
            matches!(rejection.code, ErrorCode::LeaseLost | ErrorCode::StaleEpoch)
        }
        _ => false,
    }
}

impl Collector for RemoteCollector {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.options.num_envs
    }

    fn autoreset(&self) -> AutoresetMode {
        self.options.autoreset
    }

    fn reset(&mut self, seeds: &[u64]) -> Result<(), EnvError> {
        self.seeds = seeds.to_vec();
        let LeaseState::Leased(env) = &mut self.state else { return Ok(()) };
        let result = env.reset(&ResetRequest { seeds: Some(seeds.to_vec()), mask: None }).map(drop);
        result.or_else(|error| self.check_loss(error))
    }

    fn send(&mut self, policy: &BehaviourPolicy, noise_seed: u64, steps: usize) -> Result<(), EnvError> {
        self.take_new_lease()?;
        let LeaseState::Leased(env) = &mut self.state else { return Ok(()) };
        self.sent = Instant::now();
        env.send_rollout(policy, noise_seed, steps).or_else(|error| self.check_loss(error))
    }

    fn collect(
        &mut self,
        policy: &BehaviourPolicy,
        noise_seed: u64,
        steps: usize,
        trajectory: &mut Trajectory,
    ) -> Result<bool, EnvError> {
        loop {
            if matches!(&self.state, LeaseState::Leased(env) if !env.is_pending()) {
                self.send(policy, noise_seed, steps)?;
            }
            let LeaseState::Leased(env) = &mut self.state else { return Ok(false) };
            let error = match env.recv_rollout_within(CHECK_PERIOD, trajectory) {
                Ok(()) => return Ok(true),
                Err(error) => error,
            };
            let is_timeout = matches!(client_error(&error), Some(ClientError::RequestTimeout { .. }));
            if is_timeout && (self.sent.elapsed() < LOSS_TIMEOUT || env.server_is_visible()) {
                continue;
            }
            // The next request contains the policy.
            if !is_unknown_policy(&error) {
                self.check_loss(error)?;
            }
        }
    }
}
