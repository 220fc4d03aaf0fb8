//! Settings of the task `walk` and of domain randomisation: the `[task]` and `[randomise]` tables of a config file.

use serde::{Deserialize, Serialize};

/// A closed range `[low, high]`.
pub type Range = [f32; 2];

/// Settings of a task: velocity commands, rewards, termination.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TaskConfig {
    /// The task.
    pub name: TaskName,
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
    /// Time after which a new velocity command is sampled [s].
    pub command_resample_s: f32,
    /// Ranges of the velocity commands.
    pub command: CommandRanges,
    /// Weight of each reward term; 0 disables the term.
    pub reward: RewardWeights,
    /// Width σ of the tracking rewards `exp(−error² / σ)` [m²/s², rad²/s²].
    pub tracking_sigma: f32,
    /// Tilt of the base above which the episode terminates [rad].
    pub max_tilt_rad: f32,
    /// Height of the base above the ground under it, below which the episode terminates [m].
    pub min_base_height_m: f32,
    /// Maximum initial offset of each joint from the default pose [rad].
    pub reset_joint_noise_rad: f32,
}

impl Default for TaskConfig {
    fn default() -> Self {
        Self {
            name: TaskName::Walk,
            max_episode_s: 20.0,
            command_resample_s: 10.0,
            command: CommandRanges::default(),
            reward: RewardWeights::default(),
            tracking_sigma: 0.25,
            max_tilt_rad: 1.0,
            min_base_height_m: 0.15,
            reset_joint_noise_rad: 0.1,
        }
    }
}

/// Name of a task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskName {
    /// Locomotion with velocity commands.
    #[default]
    Walk,
    /// Counts steps without physics, to verify and measure the transport. Ignores the other settings.
    Counter,
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

/// Number of reward terms.
pub const NUM_REWARD_TERMS: usize = RewardWeights::NAMES.len();

macro_rules! reward_weights {
    ($($(#[$doc:meta])* $name:ident = $weight:expr),+ $(,)?) => {
        /// Weights of the reward terms, per second: a term adds `weight · value · policy_dt` to the reward of a step.
        ///
        /// The name of a field is that of its function in [`crate::reward`], of its key and of its log entry.
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct RewardWeights { $($(#[$doc])* pub $name: f32),+ }

        impl Default for RewardWeights {
            fn default() -> Self { Self { $($name: $weight),+ } }
        }

        impl RewardWeights {
            /// Names of the terms, in the order of every per-term array.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name)),+];

            /// Returns the value of each weighted term, in the order of [`RewardWeights::NAMES`].
            pub fn evaluate(&self, input: &crate::reward::RewardInput<'_>) -> [f32; NUM_REWARD_TERMS] {
                [$(self.$name * crate::reward::$name(input) * input.policy_dt),+]
            }

            fn values(&self) -> impl Iterator<Item = (&'static str, f32)> {
                [$((stringify!($name), self.$name)),+].into_iter()
            }
        }
    };
}

// Terms and weights follow legged_gym's locomotion settings for the Go2, which U2E uses.
reward_weights! {
    /// Tracking of the commanded horizontal velocity (Isaac Lab: `track_lin_vel_xy_exp`).
    track_linear_velocity = 1.0,
    /// Tracking of the commanded yaw rate (`track_ang_vel_z_exp`).
    track_angular_velocity = 0.5,
    /// Vertical velocity of the base, squared (`lin_vel_z_l2`).
    linear_velocity_z = -2.0,
    /// Roll and pitch rates of the base, squared (`ang_vel_xy_l2`).
    angular_velocity_xy = -0.05,
    /// Tilt of the trunk (`flat_orientation_l2`).
    flat_orientation = -1.0,
    /// Joint torques, squared (`joint_torques_l2`).
    joint_torque = -0.0002,
    /// Joint accelerations, squared (`joint_acc_l2`).
    joint_acceleration = -2.5e-7,
    /// Change of the action, squared (`action_rate_l2`).
    action_rate = -0.01,
    /// Joint positions outside the soft limits (`joint_pos_limits`).
    joint_position_limits = -10.0,
    /// Long swing phases of the feet (`feet_air_time`).
    feet_air_time = 1.0,
    /// Contact of the trunk or a thigh with the ground (`undesired_contacts`).
    undesired_contact = -1.0,
    /// Offset from the default pose while the velocity command is zero.
    stand_still = -0.1,
    /// Epistemic uncertainty of the actuator networks. Only for model files with an actuator network.
    epistemic_uncertainty = 0.0,
}

/// Domain randomisation. Each value is sampled uniformly from its range at every reset.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Randomisation {
    /// Factor on the mass and inertia of every body.
    pub mass_scale: Range,
    /// Point mass at the trunk's centre of mass [kg].
    pub payload_kg: Range,
    /// Shift of the trunk's centre of mass, each axis [m].
    pub com_shift_m: Range,
    /// Factor on the ground's friction coefficient.
    pub friction_scale: Range,
    /// Factor on the position gain.
    pub kp_scale: Range,
    /// Factor on the velocity gain.
    pub kd_scale: Range,
    /// True to sample every value of the model file that has an interval from that interval.
    pub effects: bool,
}

impl Default for Randomisation {
    /// No randomisation.
    fn default() -> Self {
        Self {
            mass_scale: [1.0, 1.0],
            payload_kg: [0.0, 0.0],
            com_shift_m: [0.0, 0.0],
            friction_scale: [1.0, 1.0],
            kp_scale: [1.0, 1.0],
            kd_scale: [1.0, 1.0],
            effects: false,
        }
    }
}

/// A setting is outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{field}` = {value} is not allowed: {allowed}")]
pub struct ConfigError {
    /// The key.
    pub field: String,
    /// Its value.
    pub value: String,
    /// The allowed values.
    pub allowed: String,
}

impl TaskConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let command = &self.command;
        check_range("task.command.linear_velocity_x", command.linear_velocity_x, -5.0, 5.0)?;
        check_range("task.command.linear_velocity_y", command.linear_velocity_y, -5.0, 5.0)?;
        check_range("task.command.angular_velocity_z", command.angular_velocity_z, -5.0, 5.0)?;
        check_value("task.max_episode_s", self.max_episode_s, 0.02, 1e6)?;
        check_value("task.command_resample_s", self.command_resample_s, 0.02, 1e6)?;
        check_value("task.tracking_sigma", self.tracking_sigma, 1e-6, 1e6)?;
        check_value("task.max_tilt_rad", self.max_tilt_rad, 0.0, 3.2)?;
        check_value("task.min_base_height_m", self.min_base_height_m, -1e6, 1.0)?;
        check_value("task.reset_joint_noise_rad", self.reset_joint_noise_rad, 0.0, 1.0)?;
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))
    }
}

impl Randomisation {
    /// Checks that every range is one for which the simulation is stable.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_range("randomise.mass_scale", self.mass_scale, 0.1, 10.0)?;
        check_range("randomise.payload_kg", self.payload_kg, -3.0, 20.0)?;
        check_range("randomise.com_shift_m", self.com_shift_m, -0.2, 0.2)?;
        check_range("randomise.friction_scale", self.friction_scale, 0.0, 10.0)?;
        check_range("randomise.kp_scale", self.kp_scale, 0.0, 10.0)?;
        check_range("randomise.kd_scale", self.kd_scale, 0.0, 10.0)
    }
}

fn check_value(field: &str, value: f32, low: f32, high: f32) -> Result<(), ConfigError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ConfigError { field: field.to_owned(), value: value.to_string(), allowed: format!("{low} to {high}") })
}

fn check_range(field: &str, range: Range, low: f32, high: f32) -> Result<(), ConfigError> {
    if range[0] <= range[1] && low <= range[0] && range[1] <= high {
        return Ok(());
    }
    let allowed = format!("[low, high] with low <= high, both within {low} to {high}");
    Err(ConfigError { field: field.to_owned(), value: format!("{range:?}"), allowed })
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    #[test]
    fn error_of_an_unknown_reward_lists_the_terms() {
        let error = toml::from_str::<TaskConfig>("[reward]\ntorques = -1.0").expect_err("unknown").to_string();
        expect![[r#"
            TOML parse error at line 2, column 1
              |
            2 | torques = -1.0
              | ^^^^^^^
            unknown field `torques`, expected one of `track_linear_velocity`, `track_angular_velocity`, `linear_velocity_z`, `angular_velocity_xy`, `flat_orientation`, `joint_torque`, `joint_acceleration`, `action_rate`, `joint_position_limits`, `feet_air_time`, `undesired_contact`, `stand_still`, `epistemic_uncertainty`
        "#]].assert_eq(&error);
    }

    #[test]
    fn reversed_range_is_rejected_with_its_key() {
        let config = Randomisation { payload_kg: [2.0, 1.0], ..Randomisation::default() };
        expect![
            "`randomise.payload_kg` = [2.0, 1.0] is not allowed: [low, high] with low <= high, both within -3 to 20"
        ]
        .assert_eq(&config.check().expect_err("reversed").to_string());
    }

    #[test]
    fn defaults_are_valid() {
        assert_eq!(TaskConfig::default().check(), Ok(()));
        assert_eq!(Randomisation::default().check(), Ok(()));
    }
}
