//! Settings of the task `walk`: velocity commands, weights of the reward terms, end of an episode.

use serde::{Deserialize, Serialize};
use twinstep_model::go2;

use crate::ControlledRobot;
use crate::config::{ConfigError, Range, check_range, check_value};
use crate::reward::{self as terms, reward_weights};

/// Height of the base of a walking Go2 [m].
const GO2_BASE_HEIGHT: f64 = 0.30;
/// Height of the base below which a Go2 has fallen [m].
const GO2_MIN_HEIGHT: f64 = 0.15;

/// Largest number of frames of an observation.
const MAX_FRAMES: usize = 20;

/// The `[task]` table of `walk`: velocity commands, rewards, termination.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WalkConfig {
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
    /// Time after which a new velocity command is sampled [s].
    pub command_resample_s: f32,
    /// Probability that a new velocity command is zero: the robot stands.
    pub standing_probability: f32,
    /// Probability that a new velocity command has a heading: its yaw rate turns the robot to it, so that the robot goes
    /// straight on. Default: 0, the yaw rate is sampled.
    pub heading_probability: f32,
    /// Ranges of the velocity commands.
    pub command: CommandRanges,
    /// Weight of each reward term; 0 disables the term.
    pub reward: RewardWeights,
    /// Width σ of the tracking rewards `exp(−error² / σ)` [m²/s², rad²/s²].
    pub tracking_sigma: f32,
    /// Height of the base above the ground for the term `base_height` [m]. Default: 0.3 m for the Go2; others by their standing height.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_base_height_m: Option<f32>,
    /// Height of a swinging foot's centre above the ground for the term `feet_clearance` [m].
    pub target_foot_height_m: f32,
    /// Duration of a swing phase above which `feet_air_time` is positive [s].
    pub target_air_time_s: f32,
    /// Tilt of the base above which the episode terminates [rad].
    pub max_tilt_rad: f32,
    /// Height of the base above the ground under it, below which the episode terminates [m]. Default: 0.15 m for the Go2; others by
    /// their standing height.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_base_height_m: Option<f32>,
    /// Maximum initial offset of each joint from the default pose [rad].
    pub reset_joint_noise_rad: f32,
    /// Frames of the observation: the present one, and those of the policy steps before. Default: 1.
    pub frames: usize,
    /// True if a critic observes the heights of the ground around the robot.
    pub critic_heights: bool,
}

impl Default for WalkConfig {
    fn default() -> Self {
        Self {
            max_episode_s: 20.0,
            command_resample_s: 5.0,
            standing_probability: 0.05,
            heading_probability: 0.0,
            command: CommandRanges::default(),
            reward: RewardWeights::default(),
            tracking_sigma: 0.25,
            target_base_height_m: None,
            target_foot_height_m: 0.11,
            target_air_time_s: 0.1,
            max_tilt_rad: 1.0,
            min_base_height_m: None,
            reset_joint_noise_rad: 0.1,
            frames: 1,
            critic_heights: false,
        }
    }
}

impl WalkConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let command = &self.command;
        check_range("task.command.linear_velocity_x", command.linear_velocity_x, -5.0, 5.0)?;
        check_range("task.command.linear_velocity_y", command.linear_velocity_y, -5.0, 5.0)?;
        check_range("task.command.angular_velocity_z", command.angular_velocity_z, -5.0, 5.0)?;
        check_value("task.max_episode_s", self.max_episode_s, 0.02, 1e6)?;
        check_value("task.command_resample_s", self.command_resample_s, 0.02, 1e6)?;
        check_value("task.tracking_sigma", self.tracking_sigma, 1e-6, 1e6)?;
        check_value("task.standing_probability", self.standing_probability, 0.0, 1.0)?;
        check_value("task.heading_probability", self.heading_probability, 0.0, 1.0)?;
        if let Some(height) = self.target_base_height_m {
            check_value("task.target_base_height_m", height, 0.0, 10.0)?;
        }
        check_value("task.target_foot_height_m", self.target_foot_height_m, 0.0, 1.0)?;
        check_value("task.target_air_time_s", self.target_air_time_s, 0.0, 10.0)?;
        check_value("task.max_tilt_rad", self.max_tilt_rad, 0.0, 3.2)?;
        if let Some(height) = self.min_base_height_m {
            check_value("task.min_base_height_m", height, -1e6, 10.0)?;
        }
        check_value("task.reset_joint_noise_rad", self.reset_joint_noise_rad, 0.0, 1.0)?;
        if !(1..=MAX_FRAMES).contains(&self.frames) {
            let allowed = format!("1 to {MAX_FRAMES}");
            return Err(ConfigError { field: "task.frames".to_owned(), value: self.frames.to_string(), allowed });
        }
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))
    }

    /// Checks the settings as a part of those of another task, which adds its own entries to a single frame.
    pub(crate) fn check_as_part(&self) -> Result<(), ConfigError> {
        let refused = |key: &str, value: String, allowed: &str| {
            Err(ConfigError {
                field: format!("task.{key}"),
                value,
                allowed: format!("{allowed}; others are for the task `walk`"),
            })
        };
        match self {
            Self { frames, .. } if *frames != 1 => refused("frames", frames.to_string(), "1"),
            Self { critic_heights: true, .. } => refused("critic_heights", "true".to_owned(), "false"),
            Self { heading_probability, .. } if *heading_probability != 0.0 => {
                refused("heading_probability", heading_probability.to_string(), "0")
            }
            _ => self.check(),
        }
    }

    /// Returns the heights of the base without a penalty, and below which the episode terminates [m].
    pub(crate) fn heights(&self, robot: &ControlledRobot) -> Result<[f32; 2], ConfigError> {
        let missing = |value: &str, allowed: &str| {
            let [field, value, allowed] = ["task.name", value, allowed].map(str::to_owned);
            ConfigError { field, value, allowed }
        };
        let Some(standing) = robot.standing_height else {
            return Err(missing("walk", "`pose` for a robot whose base is fixed"));
        };
        if robot.feet.len() < 2 {
            let allowed = "`pose` for a robot without feet; name the links on which it stands in `[groups] foot` of the model file";
            return Err(missing("walk", allowed));
        }
        let go2 = ControlledRobot::from(&go2()).standing_height.expect("a quadruped stands");
        let by_size = |height: f64| (height * (standing / go2)) as f32;
        Ok([
            self.target_base_height_m.unwrap_or_else(|| by_size(GO2_BASE_HEIGHT)),
            self.min_base_height_m.unwrap_or_else(|| by_size(GO2_MIN_HEIGHT)),
        ])
    }
}

/// Ranges of the velocity command in the base frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandRanges {
    /// Forward velocity [m/s].
    pub linear_velocity_x: Range,
    /// Velocity to the left [m/s].
    pub linear_velocity_y: Range,
    /// Yaw rate, positive to the left [rad/s].
    pub angular_velocity_z: Range,
}

impl Default for CommandRanges {
    fn default() -> Self {
        Self { linear_velocity_x: [-1.0, 1.0], linear_velocity_y: [-0.5, 0.5], angular_velocity_z: [-1.0, 1.0] }
    }
}

// The terms are those of legged_gym and Isaac Lab. With these weights a policy walks after some 7 million steps
// (results/walking.md); with legged_gym's it stands still or shuffles.
reward_weights! {
    /// Tracking of the commanded horizontal velocity (Isaac Lab: `track_lin_vel_xy_exp`).
    track_linear_velocity = 2.0,
    /// Tracking of the commanded yaw rate (`track_ang_vel_z_exp`).
    track_angular_velocity = 1.0,
    /// Vertical velocity of the base, squared (`lin_vel_z_l2`).
    linear_velocity_z = -1.0,
    /// Roll and pitch rates of the base, squared (`ang_vel_xy_l2`).
    angular_velocity_xy = -0.05,
    /// Tilt of the trunk (`flat_orientation_l2`).
    flat_orientation = -2.0,
    /// Error of the base's height, squared (`base_height_l2`).
    base_height = -10.0,
    /// Joint torques, squared (`joint_torques_l2`).
    joint_torque = -1e-4,
    /// Joint accelerations, squared (`joint_acc_l2`).
    joint_acceleration = -1e-7,
    /// Change of the action, squared (`action_rate_l2`).
    action_rate = -0.01,
    /// Joint positions outside the soft limits (`joint_pos_limits`).
    joint_position_limits = -5.0,
    /// Offset of the hips from the default pose, squared.
    hip_deviation = -0.5,
    /// Long swing phases of the feet (`feet_air_time`).
    feet_air_time = 2.0,
    /// Height error of swinging feet (MuJoCo Playground: `feet_clearance`).
    feet_clearance = -2.0,
    /// Horizontal velocity of feet on the ground, squared (`feet_slide`).
    feet_slip = -0.1,
    /// Contact of the trunk or a thigh with the ground (`undesired_contacts`).
    undesired_contact = -1.0,
    /// Offset from the default pose while the velocity command is zero.
    stand_still = -0.2,
    /// End of the episode by a fall; the weight is per fall, not per second.
    termination = -5.0,
    /// Epistemic uncertainty of the actuator networks. Only for model files with an actuator network.
    epistemic_uncertainty = 0.0,
}
