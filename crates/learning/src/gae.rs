//! Generalised advantage estimation.
//!
//! Schulman et al., "High-dimensional continuous control using generalized advantage estimation", 2016, eqs. 11 and 16.

/// Discounts of the estimator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Discounts {
    /// Discount γ of the reward per step.
    pub gamma: f32,
    /// Decay λ of the estimator.
    pub lambda: f32,
}

/// Transitions of some environments over some steps, row-major: `[step][env]`.
#[derive(Clone, Copy, Debug)]
pub struct Transitions<'a> {
    /// Number of environments.
    pub num_envs: usize,
    /// Rewards.
    pub rewards: &'a [f32],
    /// Values of the states before the steps.
    pub values: &'a [f32],
    /// True where the episode ended in the step.
    pub done: &'a [bool],
    /// Value of the last state of each episode that was truncated, 0 elsewhere.
    pub truncated_values: &'a [f32],
    /// Values of the states after the last step, one per environment.
    pub last_values: &'a [f32],
}

/// Writes the advantage of each transition.
///
/// A truncated episode continues with the value of its last state; a terminated one with 0. Neither continues in the
/// next episode.
pub fn advantages(transitions: &Transitions, discounts: Discounts, advantages: &mut [f32]) {
    let Transitions { num_envs, rewards, values, done, truncated_values, last_values } = *transitions;
    let Discounts { gamma, lambda } = discounts;
    let steps = rewards.len() / num_envs;
    for step in (0..steps).rev() {
        for (env, last_value) in last_values.iter().enumerate() {
            let index = step * num_envs + env;
            let (next_value, next_advantage) = if done[index] {
                (truncated_values[index], 0.0)
            } else if step + 1 == steps {
                (*last_value, 0.0)
            } else {
                (values[index + num_envs], advantages[index + num_envs])
            };
            let delta = rewards[index] + gamma * next_value - values[index];
            advantages[index] = delta + gamma * lambda * next_advantage;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DISCOUNTS: Discounts = Discounts { gamma: 0.5, lambda: 0.5 };

    fn advantages_of(rewards: &[f32], values: &[f32], done: &[bool], truncated: &[f32], last: &[f32]) -> Vec<f32> {
        let mut result = vec![f32::NAN; rewards.len()];
        let transitions =
            Transitions { num_envs: last.len(), rewards, values, done, truncated_values: truncated, last_values: last };
        advantages(&transitions, DISCOUNTS, &mut result);
        result
    }

    #[test]
    fn episode_that_goes_on_is_computed_by_hand() {
        // δ₂ = 4 + ½·8 − 2 = 6; δ₁ = 2 + ½·2 − 4 = −1; δ₀ = 1 + ½·4 − 2 = 1; A₁ = −1 + ¼·6; A₀ = 1 + ¼·½.
        let result = advantages_of(&[1.0, 2.0, 4.0], &[2.0, 4.0, 2.0], &[false; 3], &[0.0; 3], &[8.0]);
        assert_eq!(result, [1.125, 0.5, 6.0]);
    }

    #[test]
    fn terminated_episode_has_no_value_after_its_end() {
        // δ₁ = 2 − 4 = −2 and nothing after it; δ₀ = 1 + ½·4 − 2 = 1; A₀ = 1 − ¼·2. The third step is another episode.
        let result = advantages_of(&[1.0, 2.0, 4.0], &[2.0, 4.0, 2.0], &[false, true, false], &[0.0; 3], &[8.0]);
        assert_eq!(result, [0.5, -2.0, 6.0]);
    }

    #[test]
    fn truncated_episode_continues_with_the_value_of_its_last_state() {
        // δ₁ = 2 + ½·6 − 4 = 1, without the next episode's value of 2; A₀ = 1 + ¼·1.
        let truncated = [0.0, 6.0, 0.0];
        let result = advantages_of(&[1.0, 2.0, 4.0], &[2.0, 4.0, 2.0], &[false, true, false], &truncated, &[8.0]);
        assert_eq!(result, [1.25, 1.0, 6.0]);
    }

    #[test]
    fn environments_are_independent() {
        let result = advantages_of(
            &[1.0, 9.0, 2.0, 9.0],
            &[2.0, 9.0, 4.0, 9.0],
            &[false, true, false, false],
            &[0.0; 4],
            &[2.0, 0.0],
        );
        // First environment: δ₁ = 2 + 1 − 4 = −1; δ₀ = 1 + 2 − 2 = 1; A₀ = 1 − ¼.
        assert_eq!(result, [0.75, 0.0, -1.0, 0.0]);
    }
}
