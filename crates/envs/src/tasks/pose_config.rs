//! Settings of the task `pose`.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, Range, check_range, check_value};

/// The `[task]` table of `pose`: targets of the joints, weights of the reward, and the end of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PoseConfig {
    /// Largest distance of a target from the default pose [rad or m], within the range of the joint.
    pub target_rad: f32,
    /// Time after which each robot has new targets [s].
    pub target_interval_s: Range,
    /// Largest distance of a joint from the default pose at the start [rad or m].
    pub reset_joint_noise_rad: f32,
    /// Weight of `exp(−mean squared joint error / tracking_sigma)`, per second.
    pub track_joints: f32,
    /// Width σ of the term `track_joints` [rad²].
    pub tracking_sigma: f32,
    /// Weight of the mean squared share of the torque limit that is used, per second.
    pub joint_torque: f32,
    /// Weight of the mean squared change of the action, per second.
    pub action_rate: f32,
    /// Reward for a fall.
    pub termination: f32,
    /// Angle between the base and the vertical above which a robot with a free base has fallen [rad].
    pub max_tilt_rad: f32,
    /// Height below which it has fallen, relative to that of the default pose.
    pub min_height: f32,
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            target_rad: 0.1,
            target_interval_s: [1.0, 3.0],
            reset_joint_noise_rad: 0.02,
            track_joints: 1.0,
            tracking_sigma: 0.01,
            joint_torque: -0.1,
            action_rate: -0.05,
            termination: -1.0,
            max_tilt_rad: 0.8,
            min_height: 0.5,
            max_episode_s: 20.0,
        }
    }
}

impl PoseConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_value("task.target_rad", self.target_rad, 0.0, 10.0)?;
        check_range("task.target_interval_s", self.target_interval_s, 0.02, 1e6)?;
        check_value("task.reset_joint_noise_rad", self.reset_joint_noise_rad, 0.0, 1.0)?;
        check_value("task.tracking_sigma", self.tracking_sigma, 1e-9, 1e6)?;
        let weights = [
            ("task.track_joints", self.track_joints),
            ("task.joint_torque", self.joint_torque),
            ("task.action_rate", self.action_rate),
            ("task.termination", self.termination),
        ];
        weights.into_iter().try_for_each(|(field, weight)| check_value(field, weight, -1e6, 1e6))?;
        check_value("task.max_tilt_rad", self.max_tilt_rad, 0.01, 3.2)?;
        check_value("task.min_height", self.min_height, 0.0, 1.0)?;
        check_value("task.max_episode_s", self.max_episode_s, 0.1, 1e6)
    }
}
