//! Settings of the task `gait`.

use serde::{Deserialize, Serialize};

use super::gait_clock::{ContactSchedule, Gait};
use super::gait_reward as terms;
use super::walk_config::{self, CommandRanges, WalkConfig};
use crate::config::{ConfigError, Range, check_range, check_value};
use crate::reward::reward_weights;

/// The `[task]` table of `gait`: the commanded gaits, the weights of its terms, and what it has in common with `walk`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GaitConfig {
    /// Gaits, of which one is drawn whenever a new velocity command is due.
    pub gaits: Vec<Gait>,
    /// Range of the step frequency [Hz].
    pub step_frequency_hz: Range,
    /// Share of a cycle in which a foot is to be on the ground.
    pub duty_factor: f32,
    /// Standard deviation of the transitions between stance and swing in the contact schedule [cycles].
    pub transition_std: f32,
    /// Highest position of the soles in the swing phase [m].
    pub swing_height_m: f32,
    /// Width σ of the term `contact_force` [N²].
    pub force_sigma: f32,
    /// Width σ of the term `contact_velocity` [m²/s²].
    pub velocity_sigma: f32,
    /// Weight of each term that `walk` does not have; 0 disables the term.
    pub reward: RewardWeights,
    /// Velocity commands, rewards and ends of `walk`.
    pub walk: WalkConfig,
}

impl Default for GaitConfig {
    fn default() -> Self {
        let walk = walk_config::RewardWeights {
            // The trunk rises and pitches in a bound or a pronk.
            linear_velocity_z: -0.1,
            angular_velocity_xy: -0.02,
            flat_orientation: -1.0,
            base_height: -5.0,
            // The schedule says when and how high feet swing, also while the velocity command is zero.
            feet_air_time: 0.0,
            feet_clearance: 0.0,
            stand_still: 0.0,
            ..walk_config::RewardWeights::default()
        };
        Self {
            gaits: Gait::ALL.to_vec(),
            step_frequency_hz: [2.0, 4.0],
            duty_factor: 0.5,
            transition_std: 0.07,
            swing_height_m: 0.08,
            force_sigma: 100.0,
            velocity_sigma: 1.0,
            reward: RewardWeights::default(),
            walk: WalkConfig {
                command: CommandRanges { linear_velocity_y: [0.0, 0.0], ..CommandRanges::default() },
                reward: walk,
                ..WalkConfig::default()
            },
        }
    }
}

impl GaitConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        if self.gaits.is_empty() {
            let allowed = format!("at least one of {}", Gait::ALL.map(Gait::name).join(", "));
            return Err(ConfigError { field: "task.gaits".to_owned(), value: "[]".to_owned(), allowed });
        }
        check_range("task.step_frequency_hz", self.step_frequency_hz, 0.5, 10.0)?;
        check_value("task.duty_factor", self.duty_factor, 0.1, 0.9)?;
        check_value("task.transition_std", self.transition_std, 1e-3, 0.2)?;
        check_value("task.swing_height_m", self.swing_height_m, 0.0, 0.3)?;
        check_value("task.force_sigma", self.force_sigma, 1e-6, 1e6)?;
        check_value("task.velocity_sigma", self.velocity_sigma, 1e-6, 1e6)?;
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))?;
        self.walk.check_as_part().map_err(|error| error.within("walk"))
    }

    /// Returns the contact schedule of a foot.
    pub fn schedule(&self) -> ContactSchedule {
        ContactSchedule { duty_factor: self.duty_factor, transition_std: self.transition_std }
    }
}

// Terms of Walk These Ways (tracking_contacts_shaped_force, tracking_contacts_shaped_vel, feet_clearance_cmd_linear).
reward_weights! {
    /// Swinging feet carry nothing.
    contact_force = 4.0,
    /// Feet on the ground do not move.
    contact_velocity = 4.0,
    /// Height error of swinging feet, squared.
    swing_height = -30.0,
}
