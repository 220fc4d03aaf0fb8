//! Settings of the task `getup`.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_value};

/// The `[task]` table of `getup`: starts, weights of the reward, and the length of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GetupConfig {
    /// Probability that an episode starts upright in the default pose. Others start in any orientation and pose.
    pub upright_probability: f32,
    /// Weight of `u = (1 − g_z) / 2`, per second: 1 if the base is upright, 0 if it is upside down.
    pub upright: f32,
    /// Weight of `u²` times the height of the base relative to standing, at most 1, per second.
    pub base_height: f32,
    /// Weight of that times `exp(−mean squared joint error / posture_sigma)`, per second: the default pose.
    pub posture: f32,
    /// Width σ of the term `posture` [rad²].
    pub posture_sigma: f32,
    /// Weight of the mean squared share of the torque limit that is used, per second.
    pub joint_torque: f32,
    /// Weight of the mean squared joint velocity, per second.
    pub joint_velocity: f32,
    /// Weight of the mean squared change of the action, per second.
    pub action_rate: f32,
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
}

impl Default for GetupConfig {
    fn default() -> Self {
        Self {
            upright_probability: 0.1,
            upright: 1.0,
            base_height: 2.0,
            posture: 2.0,
            posture_sigma: 0.5,
            joint_torque: -0.05,
            joint_velocity: -0.0005,
            action_rate: -0.02,
            max_episode_s: 5.0,
        }
    }
}

impl GetupConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_value("task.upright_probability", self.upright_probability, 0.0, 1.0)?;
        check_value("task.posture_sigma", self.posture_sigma, 1e-9, 1e6)?;
        let weights = [
            ("task.upright", self.upright),
            ("task.base_height", self.base_height),
            ("task.posture", self.posture),
            ("task.joint_torque", self.joint_torque),
            ("task.joint_velocity", self.joint_velocity),
            ("task.action_rate", self.action_rate),
        ];
        weights.into_iter().try_for_each(|(field, weight)| check_value(field, weight, -1e6, 1e6))?;
        check_value("task.max_episode_s", self.max_episode_s, 0.1, 1e6)
    }
}
