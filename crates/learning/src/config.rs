//! Settings of proximal policy optimisation: the `[train]` table of a config file.

use serde::{Deserialize, Serialize};

use crate::gae::Discounts;

/// Settings of proximal policy optimisation (Schulman et al. 2017).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PpoConfig {
    /// Number of robots.
    pub num_envs: usize,
    /// Number of groups of robots that are stepped in parallel.
    pub groups: usize,
    /// Steps of each robot between two updates.
    pub horizon: usize,
    /// Passes over the collected steps in each update.
    pub epochs: usize,
    /// Minibatches in each pass.
    pub minibatches: usize,
    /// Units of each hidden layer of the actor.
    pub actor_hidden: Vec<usize>,
    /// Units of each hidden layer of the critic.
    pub critic_hidden: Vec<usize>,
    /// Discount γ of the reward per step.
    pub gamma: f32,
    /// Decay λ of the advantage estimator.
    pub lambda: f32,
    /// Range of the probability ratio without clipping: 1 ± this value. The value function has the same range.
    pub clip: f32,
    /// Weight of the value loss.
    pub value_weight: f32,
    /// Weight of the entropy.
    pub entropy_weight: f32,
    /// Learning rate at the start.
    pub learning_rate: f32,
    /// Highest learning rate.
    pub max_learning_rate: f32,
    /// Kullback–Leibler divergence between two policies, to which the learning rate is adapted [nat]. 0: constant rate.
    ///
    /// It decreases to a tenth in the second half of the training.
    pub target_kl: f32,
    /// Upper limit of the norm of the gradient.
    pub max_gradient_norm: f32,
    /// Standard deviation of the actions at the start.
    pub initial_std: f32,
    /// True to learn from mirrored steps as well: left and right are exchanged in every second use of a step.
    pub symmetry: bool,
    /// Total number of environment steps.
    pub total_steps: u64,
}

impl Default for PpoConfig {
    fn default() -> Self {
        Self {
            num_envs: 1024,
            groups: 8,
            horizon: 24,
            epochs: 2,
            minibatches: 4,
            actor_hidden: vec![128, 128],
            critic_hidden: vec![64, 64],
            gamma: 0.98,
            lambda: 0.95,
            clip: 0.2,
            value_weight: 1.0,
            entropy_weight: 5e-4,
            learning_rate: 1e-3,
            max_learning_rate: 3e-3,
            target_kl: 0.02,
            max_gradient_norm: 1.0,
            initial_std: 0.5,
            symmetry: false,
            total_steps: 8_000_000,
        }
    }
}

/// A setting is outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`train.{field}` = {value} is not allowed: {allowed}")]
pub struct PpoConfigError {
    /// The key.
    pub field: &'static str,
    /// Its value.
    pub value: String,
    /// The allowed values.
    pub allowed: String,
}

impl PpoConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), PpoConfigError> {
        let count = |field, value: usize, limit: usize| {
            if (1..=limit).contains(&value) {
                return Ok(());
            }
            Err(PpoConfigError { field, value: value.to_string(), allowed: format!("1 to {limit}") })
        };
        let number = |field, value: f32, low: f32, high: f32| {
            if (low..=high).contains(&value) {
                return Ok(());
            }
            Err(PpoConfigError { field, value: value.to_string(), allowed: format!("{low} to {high}") })
        };
        count("num_envs", self.num_envs, 1_000_000)?;
        count("groups", self.groups, self.num_envs)?;
        count("horizon", self.horizon, 10_000)?;
        count("epochs", self.epochs, 1000)?;
        count("minibatches", self.minibatches, self.num_envs * self.horizon)?;
        for (field, hidden) in [("actor_hidden", &self.actor_hidden), ("critic_hidden", &self.critic_hidden)] {
            count(field, hidden.len(), 8)?;
            hidden.iter().try_for_each(|units| count(field, *units, 4096))?;
        }
        number("gamma", self.gamma, 0.0, 1.0)?;
        number("lambda", self.lambda, 0.0, 1.0)?;
        number("clip", self.clip, 1e-3, 10.0)?;
        number("value_weight", self.value_weight, 0.0, 100.0)?;
        number("entropy_weight", self.entropy_weight, 0.0, 1.0)?;
        number("learning_rate", self.learning_rate, 1e-8, 1.0)?;
        number("max_learning_rate", self.max_learning_rate, self.learning_rate, 1.0)?;
        number("target_kl", self.target_kl, 0.0, 10.0)?;
        number("max_gradient_norm", self.max_gradient_norm, 1e-6, 1e6)?;
        number("initial_std", self.initial_std, 1e-3, 10.0)
    }

    /// Returns the number of environment steps between two updates.
    pub fn batch_len(&self) -> usize {
        self.num_envs * self.horizon
    }

    /// Returns the discounts.
    pub fn discounts(&self) -> Discounts {
        Discounts { gamma: self.gamma, lambda: self.lambda }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_errors_name_the_key_and_its_range() {
        assert_eq!(PpoConfig::default().check(), Ok(()));
        let error = |config: PpoConfig| config.check().expect_err("invalid").to_string();
        let nan = PpoConfig { gamma: f32::NAN, ..PpoConfig::default() };
        assert_eq!(error(nan), "`train.gamma` = NaN is not allowed: 0 to 1");
        let wide = PpoConfig { actor_hidden: vec![64, 5000], ..PpoConfig::default() };
        assert_eq!(error(wide), "`train.actor_hidden` = 5000 is not allowed: 1 to 4096");
    }
}
