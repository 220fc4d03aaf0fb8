//! Limits and times of the safety state machine: the `[safety]` table of a config file.

use serde::{Deserialize, Serialize};

use crate::unsafe_command::UnsafeCommand;

/// Limits and times of the safety state machine.
///
/// The defaults without a source in their comment are cautious choices, not numbers of the vendor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SafetyConfig {
    /// Commanded positions stay within this fraction of each joint's range, about its middle.
    pub soft_joint_limit_factor: f32,
    /// A measured position outside this multiple of a joint's range is a fault.
    pub max_joint_limit_factor: f32,
    /// Largest change of a joint's commanded position from one policy period to the next [rad].
    pub max_target_step_rad: f32,
    /// Largest position gain of a command [N·m/rad].
    pub max_kp: f32,
    /// Largest velocity gain of a command [N·m·s/rad].
    pub max_kd: f32,
    /// Velocity gain of the damping mode [N·m·s/rad].
    pub damping_kd: f32,
    /// Position gain of hip, thigh and calf while standing [N·m/rad]. Source: FixStand of unitree_rl_lab.
    pub stand_kp: [f32; 3],
    /// Velocity gain of hip, thigh and calf while standing [N·m·s/rad]. Source: FixStand of unitree_rl_lab.
    pub stand_kd: [f32; 3],
    /// Time to move from the measured pose to the crouched pose [s].
    pub crouch_s: f64,
    /// Time to move from the crouched pose to the default pose, and from any pose to the crouched one when sitting [s].
    pub stand_s: f64,
    /// Standing is reached if every joint is closer than this to its commanded position [rad].
    pub stand_tolerance_rad: f32,
    /// Largest tilt of the trunk at which the robot may stand up [°].
    pub stand_max_tilt_deg: f32,
    /// Largest speed of a joint at which the robot may stand up [rad/s].
    pub stand_max_speed_rad_s: f32,
    /// A larger tilt of the trunk is a fault [°].
    pub max_tilt_deg: f32,
    /// A larger angle between accelerometer and orientation, both averaged, is a fault [°].
    pub max_imu_disagreement_deg: f32,
    /// A torque above this fraction of a joint's limit is a fault if it lasts for `max_torque_ms`.
    pub max_torque_factor: f32,
    /// Time for which a torque may be above `max_torque_factor` [ms].
    pub max_torque_ms: u64,
    /// A higher motor temperature is a fault [°C].
    pub max_temperature_c: i16,
    /// Highest motor temperature at which the robot may be armed [°C].
    pub arm_max_temperature_c: i16,
    /// A lower supply voltage is a fault [V].
    pub min_voltage_v: f32,
    /// Lowest charge of the battery at which the robot may be armed [%].
    pub arm_min_charge_percent: u8,
    /// More lost messages between main board and motors within a second are a fault.
    pub max_lost_messages: u32,
    /// Lowest rate of states at which the robot counts as connected [Hz].
    pub min_state_hz: u32,
    /// An older state is a fault, if it is found twice in a row [ms]. Above 30, only on a host that cannot keep time, with a
    /// fake robot; as for `max_pause_ms` above 50 and `watchdog_timeout_ms` above 20.
    pub state_timeout_ms: u64,
    /// A longer time between two steps of the control loop while the robot moves is a fault [ms].
    pub max_pause_ms: u64,
    /// The watchdog damps the motors after this time without a command of the control loop [ms].
    pub watchdog_timeout_ms: u64,
    /// The remote control is lost after this time without it [ms].
    pub remote_timeout_ms: u64,
    /// True if the robot may move only while its remote control is received.
    pub remote_required: bool,
    /// Number of missed actions from which the pose is held with the gains of standing.
    pub hold_after_missed_ticks: u64,
    /// Number of missed actions from which the robot sits down.
    pub sit_after_missed_ticks: u64,
}

impl Default for SafetyConfig {
    fn default() -> Self {
        Self {
            soft_joint_limit_factor: 0.95,
            max_joint_limit_factor: 1.1,
            max_target_step_rad: 0.5,
            max_kp: 100.0,
            max_kd: 10.0,
            damping_kd: 3.0,
            stand_kp: [60.0, 80.0, 80.0],
            stand_kd: [5.0, 4.0, 4.0],
            crouch_s: 1.0,
            stand_s: 2.0,
            stand_tolerance_rad: 0.15,
            stand_max_tilt_deg: 30.0,
            stand_max_speed_rad_s: 0.5,
            max_tilt_deg: 60.0,
            max_imu_disagreement_deg: 40.0,
            max_torque_factor: 0.9,
            max_torque_ms: 300,
            max_temperature_c: 85,
            arm_max_temperature_c: 70,
            min_voltage_v: 24.0,
            arm_min_charge_percent: 20,
            max_lost_messages: 20,
            min_state_hz: 400,
            state_timeout_ms: 20,
            max_pause_ms: 50,
            watchdog_timeout_ms: 20,
            remote_timeout_ms: 1000,
            remote_required: true,
            hold_after_missed_ticks: 3,
            sit_after_missed_ticks: 10,
        }
    }
}

/// A setting is not allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// A number is outside its range.
    #[error("`safety.{field}` = {value} is outside {low} to {high}; choose a number in this range")]
    OutOfRange {
        /// Name of the setting.
        field: &'static str,
        /// Its value.
        value: f64,
        /// Lowest allowed value.
        low: f64,
        /// Highest allowed value.
        high: f64,
    },
    /// The gains or the default pose of the robot are outside the limits.
    #[error("the control of the robot is outside the limits of `[safety]`: {0}")]
    Control(#[from] UnsafeCommand),
}

impl SafetyConfig {
    /// Checks that every setting is in its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let number = f64::from;
        let [kp, kd] = [self.stand_kp, self.stand_kd];
        let gains = (0..3).flat_map(|kind| {
            [
                ("stand_kp", number(kp[kind]), 0.0, number(self.max_kp)),
                ("stand_kd", number(kd[kind]), 0.0, number(self.max_kd)),
            ]
        });
        let settings = [
            ("soft_joint_limit_factor", number(self.soft_joint_limit_factor), 0.5, 1.0),
            ("max_joint_limit_factor", number(self.max_joint_limit_factor), 1.0, 1.5),
            ("max_target_step_rad", number(self.max_target_step_rad), 0.01, 1.0),
            ("max_kp", number(self.max_kp), 1.0, 150.0),
            ("max_kd", number(self.max_kd), 0.1, 15.0),
            ("damping_kd", number(self.damping_kd), 1.0, number(self.max_kd)),
            ("crouch_s", self.crouch_s, 0.2, 10.0),
            ("stand_s", self.stand_s, 0.2, 10.0),
            ("stand_tolerance_rad", number(self.stand_tolerance_rad), 0.01, 0.5),
            ("stand_max_tilt_deg", number(self.stand_max_tilt_deg), 1.0, number(self.max_tilt_deg)),
            ("stand_max_speed_rad_s", number(self.stand_max_speed_rad_s), 0.01, 5.0),
            ("max_tilt_deg", number(self.max_tilt_deg), 10.0, 85.0),
            ("max_imu_disagreement_deg", number(self.max_imu_disagreement_deg), 10.0, 180.0),
            ("max_torque_factor", number(self.max_torque_factor), 0.1, 1.0),
            ("max_torque_ms", self.max_torque_ms as f64, 2.0, 2000.0),
            ("max_temperature_c", number(f32::from(self.max_temperature_c)), 40.0, 100.0),
            ("arm_max_temperature_c", f64::from(self.arm_max_temperature_c), 30.0, f64::from(self.max_temperature_c)),
            ("min_voltage_v", number(self.min_voltage_v), 20.0, 30.0),
            ("arm_min_charge_percent", f64::from(self.arm_min_charge_percent), 0.0, 100.0),
            ("max_lost_messages", f64::from(self.max_lost_messages), 1.0, 1000.0),
            ("min_state_hz", f64::from(self.min_state_hz), 100.0, 1000.0),
            ("state_timeout_ms", self.state_timeout_ms as f64, 4.0, 200.0),
            ("max_pause_ms", self.max_pause_ms as f64, 10.0, 500.0),
            ("watchdog_timeout_ms", self.watchdog_timeout_ms as f64, 10.0, 200.0),
            ("remote_timeout_ms", self.remote_timeout_ms as f64, 100.0, 5000.0),
            ("hold_after_missed_ticks", self.hold_after_missed_ticks as f64, 1.0, 50.0),
            (
                "sit_after_missed_ticks",
                self.sit_after_missed_ticks as f64,
                self.hold_after_missed_ticks as f64 + 1.0,
                100.0,
            ),
        ];
        // NaN is in no range.
        let outside = settings.into_iter().chain(gains).find(|(_, value, low, high)| !(low..=high).contains(&value));
        outside.map_or(Ok(()), |(field, value, low, high)| Err(ConfigError::OutOfRange { field, value, low, high }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_in_their_ranges() {
        assert_eq!(SafetyConfig::default().check(), Ok(()));
    }

    #[test]
    fn setting_outside_its_range_is_named_with_what_is_allowed() {
        let config = SafetyConfig { state_timeout_ms: 500, ..SafetyConfig::default() };
        let text = config.check().expect_err("too long").to_string();
        assert_eq!(text, "`safety.state_timeout_ms` = 500 is outside 4 to 200; choose a number in this range");
        let config = SafetyConfig { damping_kd: f32::NAN, ..SafetyConfig::default() };
        assert!(config.check().expect_err("not a number").to_string().contains("damping_kd"));
        let config = SafetyConfig { sit_after_missed_ticks: 3, ..SafetyConfig::default() };
        assert!(config.check().is_err(), "sits before it holds");
    }

    #[test]
    fn unknown_key_is_rejected() {
        let error = toml::from_str::<SafetyConfig>("max_tilt = 20").expect_err("no such key").to_string();
        assert!(error.contains("max_tilt_deg"), "{error}");
        let config: SafetyConfig = toml::from_str("max_tilt_deg = 20").expect("a config");
        assert_eq!(config, SafetyConfig { max_tilt_deg: 20.0, ..SafetyConfig::default() });
    }
}
