//! Collection of trajectories: the policy runs next to the robots, wherever they are.

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, Trajectory, VecEnv};

use crate::behaviour::{ActionSampler, BehaviourPolicy};

/// Environments that can be run with a policy, in this process or on a server.
pub trait Collector: Send {
    /// Returns layouts, periods, gains and limits of the environments.
    fn spec(&self) -> &EnvSpec;

    /// Returns the number of environments.
    fn num_envs(&self) -> usize;

    /// Returns when an environment is reset after the end of its episode.
    fn autoreset(&self) -> AutoresetMode;

    /// Starts an episode of each environment, with one seed per environment.
    fn reset(&mut self, seeds: &[u64]) -> Result<(), EnvError>;

    /// Returns the mean level of the robots on a course. `None` without one, and for robots of a server.
    fn mean_level(&self) -> Option<f64> {
        None
    }

    /// Sends the request for a trajectory without waiting, so that several collectors work at the same time.
    ///
    /// [`Collector::collect`] with the same arguments follows. Does nothing in this process.
    fn send(&mut self, _policy: &BehaviourPolicy, _noise_seed: u64, _steps: usize) -> Result<(), EnvError> {
        Ok(())
    }

    /// Runs `policy` for `steps` steps of all environments from their current observations.
    ///
    /// The noise of environment `i` is a function of `noise_seed + i` alone, so equal arguments give equal bits.
    /// Returns false, without a trajectory, while the environments cannot be reached. Once they can be reached again,
    /// they are in new episodes.
    fn collect(
        &mut self,
        policy: &BehaviourPolicy,
        noise_seed: u64,
        steps: usize,
        trajectory: &mut Trajectory,
    ) -> Result<bool, EnvError>;
}

/// Runs the policy in this process and steps the environments with its actions.
pub struct StepCollector(pub Box<dyn VecEnv>);

impl Collector for StepCollector {
    fn spec(&self) -> &EnvSpec {
        self.0.spec()
    }

    fn num_envs(&self) -> usize {
        self.0.num_envs()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.0.autoreset()
    }

    fn mean_level(&self) -> Option<f64> {
        self.0.mean_level()
    }

    fn reset(&mut self, seeds: &[u64]) -> Result<(), EnvError> {
        self.0.reset(&ResetRequest { seeds: Some(seeds.to_vec()), mask: None }).map(drop)
    }

    fn collect(
        &mut self,
        policy: &BehaviourPolicy,
        noise_seed: u64,
        steps: usize,
        trajectory: &mut Trajectory,
    ) -> Result<bool, EnvError> {
        let env = &mut *self.0;
        trajectory.start(steps, env.spec(), env.obs(), env.critic_obs());
        let mut sampler = ActionSampler::new(policy, noise_seed, env.num_envs());
        for _ in 0..steps {
            sampler.step(env, trajectory)?;
        }
        Ok(true)
    }
}
