//! Robots of a server that collect trajectories for a learner, and are leased again after their server was lost.

use std::time::Instant;

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, Trajectory, VecEnv};
use twinstep_policy::{BehaviourPolicy, Collector};

use crate::recovery::{CHECK_PERIOD, LOSS_TIMEOUT, Recovery, is_loss, is_timeout, recovery_seed};
use crate::remote_env::is_unknown_policy;
use crate::{ConnectOptions, RemoteVecEnv};

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
    Lost(Recovery),
    /// The search for a new lease could not be started, or the collector is dropped.
    None,
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
        let LeaseState::Lost(recovery) = &self.state else { return Ok(()) };
        let Some(mut env) = recovery.take() else { return Ok(()) };
        let seeds = self.seeds.iter().map(|seed| recovery_seed(*seed, self.losses)).collect();
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
        if let LeaseState::Leased(env) = std::mem::replace(&mut self.state, LeaseState::None) {
            self.state = LeaseState::Lost(Recovery::start(vec![self.options.clone()], *env)?);
        }
        self.losses += 1;
        Ok(())
    }
}

impl Drop for RemoteCollector {
    /// Ends the lease, so that its robots are free at once.
    fn drop(&mut self) {
        if let LeaseState::Leased(env) = std::mem::replace(&mut self.state, LeaseState::None)
            && env.server_is_visible()
            && let Err(error) = env.close()
        {
            tracing::debug!(%error, "lease not closed");
        }
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
            if is_timeout(&error) && (self.sent.elapsed() < LOSS_TIMEOUT || env.server_is_visible()) {
                continue;
            }
            // The next request contains the policy.
            if !is_unknown_policy(&error) {
                self.check_loss(error)?;
            }
        }
    }
}
