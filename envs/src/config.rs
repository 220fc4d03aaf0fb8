//! What the task `walk` asks and how episodes vary: the `[task]` and `[randomise]` tables of a config file.

use serde::{Deserialize, Serialize};

/// A closed range `[low, high]`.
pub type Range = [f32; 2];

/// The task: commands, rewards, ends of episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TaskConfig {
    /// Which task.
    pub name: TaskName,
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
    /// Time after which a new velocity command is drawn [s].
    pub command_resample_s: f32,
    /// Ranges that velocity commands are drawn from.
    pub command: CommandRanges,
    /// Weight of each reward term; 0 leaves it out of the sum.
    pub reward: RewardWeights,
    /// Width of the tracking rewards' bell, `exp(−error² / width)` [m²/s², rad²/s²].
    pub tracking_sigma: f32,
    /// The episode ends when the base tilts by more than this [rad].
    pub max_tilt_rad: f32,
    /// The episode ends when the base sinks below this height above the ground under it [m].
    pub min_base_height_m: f32,
    /// Joints start within this distance of the default pose [rad].
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

/// The tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskName {
    /// Follow velocity commands.
    #[default]
    Walk,
    /// No physics: count steps, to prove and to measure the transport. The other settings do not matter to it.
    Counter,
}

/// Ranges of the velocity command, in the base frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandRanges {
    /// Forward velocity [m/s].
    pub linear_velocity_x: Range,
    /// Velocity to the left [m/s].
    pub linear_velocity_y: Range,
    /// Turning rate to the left [rad/s].
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
        /// Weights of the reward terms, per second: a term counts `weight · value · policy_dt` each step.
        ///
        /// A field's name is the name of its function in [`crate::reward`], of its key and of its log entry.
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct RewardWeights { $($(#[$doc])* pub $name: f32),+ }

        impl Default for RewardWeights {
            fn default() -> Self { Self { $($name: $weight),+ } }
        }

        impl RewardWeights {
            /// Names of the terms, in the order of every per-term array.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name)),+];

            /// Each weighted term of `moment`, in the order of [`RewardWeights::NAMES`].
            pub fn evaluate(&self, moment: &crate::reward::Moment<'_>) -> [f32; TERMS] {
                [$(self.$name * crate::reward::$name(moment) * moment.policy_dt),+]
            }

            fn values(&self) -> impl Iterator<Item = (&'static str, f32)> {
                [$((stringify!($name), self.$name)),+].into_iter()
            }
        }
    };
}

// Terms and weights follow the locomotion settings that U2E builds on (legged_gym's, for a Go2).
reward_weights! {
    /// Follows the commanded horizontal velocity.
    track_linear_velocity = 1.0,
    /// Follows the commanded turning rate.
    track_angular_velocity = 0.5,
    /// Bouncing.
    linear_velocity_z = -2.0,
    /// Rolling and pitching.
    angular_velocity_xy = -0.05,
    /// A trunk that is not level.
    orientation = -1.0,
    /// Torque squared.
    torque = -0.0002,
    /// Change of joint velocity squared.
    joint_acceleration = -2.5e-7,
    /// Change of action squared.
    action_rate = -0.01,
    /// Joints near the ends of their range.
    joint_position_limits = -10.0,
    /// Long steps.
    feet_air_time = 1.0,
    /// Trunk or thigh on the ground.
    body_contact = -1.0,
    /// Moving joints while commanded to stand.
    stand_still = -0.1,
    /// Motions that the learned drives of the model file know little about; only with such drives.
    uncertainty = 0.0,
}

/// How bodies and drives differ from episode to episode; each value is drawn from its range at every reset.
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
    /// True to draw every value of the model file that has an interval from it.
    pub effects: bool,
}

impl Default for Randomisation {
    /// The robot exactly as its model has it.
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

/// A setting outside what is allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{field}` = {value} is not allowed: {allowed}")]
pub struct ConfigError {
    /// The key.
    pub field: String,
    /// Its value.
    pub value: String,
    /// What is allowed.
    pub allowed: String,
}

impl TaskConfig {
    /// Fails if a value is outside its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let command = &self.command;
        check_range("task.command.forward", command.linear_velocity_x, -5.0, 5.0)?;
        check_range("task.command.left", command.linear_velocity_y, -5.0, 5.0)?;
        check_range("task.command.yaw", command.angular_velocity_z, -5.0, 5.0)?;
        check_value("task.max_episode_s", self.max_episode_s, 0.02, 1e6)?;
        check_value("task.command_resample_s", self.command_resample_s, 0.02, 1e6)?;
        check_value("task.tracking_width", self.tracking_sigma, 1e-6, 1e6)?;
        check_value("task.max_tilt_rad", self.max_tilt_rad, 0.0, 3.2)?;
        check_value("task.min_base_height_m", self.min_base_height_m, -1e6, 1.0)?;
        check_value("task.start_position_noise_rad", self.reset_joint_noise_rad, 0.0, 1.0)?;
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))
    }
}

impl Randomisation {
    /// Fails if a range is outside what the robot survives.
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
    fn misspelt_reward_is_answered_with_the_terms() {
        let error = toml::from_str::<TaskConfig>("[reward]\ntorques = -1.0").expect_err("unknown").to_string();
        expect![[r#"
            TOML parse error at line 2, column 1
              |
            2 | torques = -1.0
              | ^^^^^^^
            unknown field `torques`, expected one of `track_linear_velocity`, `track_angular_velocity`, `linear_velocity_z`, `angular_velocity_xy`, `orientation`, `torque`, `joint_acceleration`, `action_rate`, `joint_position_limits`, `feet_air_time`, `body_contact`, `stand_still`, `uncertainty`
        "#]].assert_eq(&error);
    }

    #[test]
    fn reversed_range_is_refused_by_name() {
        let config = Randomisation { payload_kg: [2.0, 1.0], ..Randomisation::default() };
        expect![
            "`randomise.payload_kg` = [2.0, 1.0] is not allowed: [low, high] with low <= high, both within -3 to 20"
        ]
        .assert_eq(&config.check().expect_err("reversed").to_string());
    }

    #[test]
    fn defaults_are_allowed() {
        assert_eq!(TaskConfig::default().check(), Ok(()));
        assert_eq!(Randomisation::default().check(), Ok(()));
    }
}
