//! The task `counter`: no physics, and an observation that verifies which steps were executed.
//!
//! It has the layout of `walk`. Its observation contains the total number of steps and of resets of the environment,
//! and a running hash of all actions in their order. A step that is repeated, lost or inserted changes the next
//! observation. The task also measures the transport without the cost of physics.

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, RobotModel, StepBatch, VecEnv};

use crate::observation::{OBS_LEN, base_spec};

/// Vectorised environments that count steps instead of simulating robots.
pub struct CounterEnv {
    spec: EnvSpec,
    autoreset: AutoresetMode,
    batch: StepBatch,
    counters: Vec<Counter>,
}

/// State of one counter. A client that updates its own and compares [`Counter::observation`] verifies every step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counter {
    /// Steps executed since the environment was created.
    pub steps: u32,
    /// Resets executed since the environment was created.
    pub resets: u32,
    /// Hash of all actions in their order.
    pub action_hash: u32,
}

impl Counter {
    /// Counts one step.
    pub fn step(&mut self, action: &[f32]) {
        self.steps += 1;
        for value in action {
            self.action_hash = (self.action_hash ^ value.to_bits()).wrapping_mul(0x0100_0193).rotate_left(5);
        }
    }

    /// Counts one reset.
    pub fn reset(&mut self) {
        self.resets += 1;
    }

    /// Returns the first entries of the observation: integers below 2²⁴, which `f32` represents exactly.
    pub fn observation(&self) -> [f32; 4] {
        [
            (self.steps & 0xff_ffff) as f32,
            self.resets as f32,
            (self.action_hash >> 16) as f32,
            (self.action_hash & 0xffff) as f32,
        ]
    }
}

impl CounterEnv {
    /// Creates `num_envs` counters.
    pub fn new(robot: &RobotModel, num_envs: usize, autoreset: AutoresetMode) -> Self {
        let mut spec = base_spec("counter", robot, Vec::new(), 20.0);
        for field in &mut spec.observation {
            (field.low, field.high) = (-16_777_216.0, 16_777_216.0);
        }
        Self { batch: StepBatch::new(num_envs, &spec), spec, autoreset, counters: vec![Counter::default(); num_envs] }
    }

    fn observe(&mut self, env: usize) {
        let row = &mut self.batch.obs[env * OBS_LEN..(env + 1) * OBS_LEN];
        row[..4].copy_from_slice(&self.counters[env].observation());
    }
}

impl VecEnv for CounterEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.counters.len()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.autoreset
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        request.check(self.num_envs())?;
        for env in (0..self.num_envs()).filter(|env| request.selects(*env)) {
            self.counters[env].reset();
            self.observe(env);
        }
        Ok(&self.batch.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let action_len = self.spec.action_len();
        self.spec.check_actions(actions, self.num_envs())?;
        if let Some(env) = self.counters.iter().position(|counter| counter.resets == 0) {
            return Err(EnvError::NeedsReset { env });
        }
        for (env, action) in actions.chunks_exact(action_len).enumerate() {
            self.counters[env].step(action);
            self.observe(env);
            self.batch.obs[env * OBS_LEN + 33..(env + 1) * OBS_LEN].copy_from_slice(action);
            self.batch.reward[env] = self.counters[env].steps as f32;
        }
        Ok(&self.batch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_depends_on_the_order_of_actions() {
        let (mut forward, mut backward) = (Counter::default(), Counter::default());
        forward.step(&[0.1, 0.2]);
        forward.step(&[0.3, 0.4]);
        backward.step(&[0.3, 0.4]);
        backward.step(&[0.1, 0.2]);
        assert_eq!(forward.steps, backward.steps);
        assert_ne!(forward.action_hash, backward.action_hash);
    }
}
