//! Settings of the task `jump`.

use serde::{Deserialize, Serialize};

use super::jump_reward as terms;
use super::walk_config::{self, WalkConfig};
use crate::config::{ConfigError, Range, check_range, check_value};
use crate::reward::reward_weights;

/// The `[task]` table of `jump`: the targets, the weights of its terms, and what it has in common with `walk`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JumpConfig {
    /// Range of the distance of the target, forward [m].
    pub target_x_m: Range,
    /// Range of the distance of the target to the left [m].
    pub target_y_m: Range,
    /// Range of the angle by which the robot turns, positive to the left [rad].
    pub target_yaw_rad: Range,
    /// Time in which the phase of the observation goes from 0 to 1 [s].
    pub phase_s: f32,
    /// Time after which terms of the take-off are zero [s].
    pub takeoff_s: f32,
    /// Vertical velocity of the take-off of the reward terms [m/s].
    pub takeoff_velocity_z: f32,
    /// Height of the feet in flight relative to the base [m].
    pub target_foot_z_m: f32,
    /// Weight of each term that `walk` does not have; 0 disables the term.
    pub reward: RewardWeights,
    /// Penalties and ends of `walk`. Its velocity command is zero.
    pub walk: WalkConfig,
}

impl Default for JumpConfig {
    fn default() -> Self {
        let penalties = walk_config::RewardWeights {
            angular_velocity_xy: -0.05,
            flat_orientation: -2.0,
            joint_torque: -1e-4,
            joint_acceleration: -1e-7,
            action_rate: -0.01,
            joint_position_limits: -5.0,
            hip_deviation: -0.5,
            undesired_contact: -2.0,
            termination: -5.0,
            ..walk_config::RewardWeights::default().scaled(0.0)
        };
        Self {
            target_x_m: [0.2, 0.9],
            target_y_m: [0.0, 0.0],
            target_yaw_rad: [0.0, 0.0],
            phase_s: 1.0,
            takeoff_s: 0.8,
            takeoff_velocity_z: 2.0,
            target_foot_z_m: -0.2,
            reward: RewardWeights::default(),
            walk: WalkConfig {
                max_episode_s: 3.0,
                min_base_height_m: Some(0.1),
                reset_joint_noise_rad: 0.05,
                reward: penalties,
                ..WalkConfig::default()
            },
        }
    }
}

impl JumpConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_range("task.target_x_m", self.target_x_m, -5.0, 5.0)?;
        check_range("task.target_y_m", self.target_y_m, -5.0, 5.0)?;
        check_range("task.target_yaw_rad", self.target_yaw_rad, -3.1, 3.1)?;
        check_value("task.phase_s", self.phase_s, 0.02, 1e3)?;
        check_value("task.takeoff_s", self.takeoff_s, 0.0, 1e3)?;
        check_value("task.takeoff_velocity_z", self.takeoff_velocity_z, 0.1, 10.0)?;
        check_value("task.target_foot_z_m", self.target_foot_z_m, -1.0, 1.0)?;
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))?;
        self.walk.check_as_part().map_err(|error| error.within("walk"))
    }
}

// Names of U2E, Table II. Its weights are scaled to those of the penalties; a landing counts once.
reward_weights! {
    /// Distance of the landing from the target; the weight is per landing, not per second.
    landing_position = 5.0,
    /// Landing within 5 cm and 0.2 rad of the target; the weight is per landing, not per second.
    success = 5.0,
    /// No foot touches the ground.
    in_air = 6.0,
    /// Horizontal velocity before the take-off.
    takeoff_velocity_xy = 1.0,
    /// Vertical velocity before the take-off.
    takeoff_velocity_z = 2.0,
    /// Yaw rate before the take-off.
    takeoff_yaw_rate = 1.0,
    /// Predicted distance of the landing from the target before the take-off.
    takeoff_prediction = 2.0,
    /// Legs drawn up in flight.
    feet_relative_z = 2.0,
    /// Difference between left and right.
    symmetry = -0.5,
    /// Predicted distance of the landing from the target in flight, and the actual one after it.
    landing_prediction = 10.0,
    /// Standing in the default pose after the landing.
    recovery = 4.0,
}
