//! Settings of the fake robot, and why it cannot be made.

use serde::{Deserialize, Serialize};
use twinstep_model::{BackendError, Joint, PerJoint};

/// Settings of the fake robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FakeConfig {
    /// Seed of noise and losses.
    pub seed: u64,
    /// Joint positions at the start [rad]. The robot lies down from there. Default: crouched.
    pub start: PerJoint,
    /// True if the built-in controller is active at the start, as on a robot that was just switched on.
    pub controller_active: bool,
    /// True if position and velocity of the base are published without the built-in controller too.
    pub motion_capture: bool,
    /// Friction of the gears of a joint without a commanded position [N·m]. Not documented for the Go2; without it, and
    /// without friction in the model, a limp robot rolls over its folded legs.
    pub gear_friction_nm: f32,
    /// Charge of the battery at the start [%].
    pub charge_percent: f32,
    /// Temperature of the surroundings [°C].
    pub ambient_c: f32,
    /// Standard deviation of the noise of joint positions [rad].
    pub position_noise_rad: f32,
    /// Standard deviation of the noise of joint velocities [rad/s].
    pub velocity_noise_rad_s: f32,
    /// Standard deviation of the noise of joint torques [N·m].
    pub torque_noise_nm: f32,
    /// Standard deviation of the noise of each angle of the orientation [rad].
    pub orientation_noise_rad: f32,
    /// Standard deviation of the noise of the gyroscope [rad/s].
    pub gyro_noise_rad_s: f32,
    /// Standard deviation of the noise of the accelerometer [m/s²].
    pub acc_noise_m_s2: f32,
}

impl Default for FakeConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            start: Joint::map_kinds(0.0, 1.36, -2.65),
            controller_active: true,
            motion_capture: false,
            gear_friction_nm: 0.0,
            charge_percent: 80.0,
            ambient_c: 30.0,
            position_noise_rad: 0.0005,
            velocity_noise_rad_s: 0.02,
            torque_noise_nm: 0.1,
            orientation_noise_rad: 0.0005,
            gyro_noise_rad_s: 0.003,
            acc_noise_m_s2: 0.05,
        }
    }
}

/// The fake robot cannot be made or simulated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FakeError {
    /// The backend has another number of robots.
    #[error("the backend of the fake has {0} robots; give it one with 1 robot")]
    NumRobots(usize),
    /// The actuators have another rate.
    #[error("`control.actuator_hz` of the fake's model is {0}; the Go2 sends and receives at 500 Hz: set it to 500")]
    Rate(f64),
    /// The backend is not simulated.
    #[error("the backend of the fake gives no ground truth; use a simulator")]
    NotSimulated,
    /// A setting is not allowed.
    #[error("`{field}` of the fake is {value}, outside {low} to {high}; choose a number in this range")]
    OutOfRange {
        /// Key.
        field: &'static str,
        /// Value.
        value: f32,
        /// Lowest allowed value.
        low: f32,
        /// Highest allowed value.
        high: f32,
    },
    /// The simulation failed.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl FakeConfig {
    pub(super) fn check(&self) -> Result<(), FakeError> {
        let settings = [
            ("charge_percent", self.charge_percent, 0.0, 100.0),
            ("ambient_c", self.ambient_c, -20.0, 60.0),
            ("gear_friction_nm", self.gear_friction_nm, 0.0, 2.0),
            ("position_noise_rad", self.position_noise_rad, 0.0, 0.1),
            ("velocity_noise_rad_s", self.velocity_noise_rad_s, 0.0, 1.0),
            ("torque_noise_nm", self.torque_noise_nm, 0.0, 10.0),
            ("orientation_noise_rad", self.orientation_noise_rad, 0.0, 0.1),
            ("gyro_noise_rad_s", self.gyro_noise_rad_s, 0.0, 1.0),
            ("acc_noise_m_s2", self.acc_noise_m_s2, 0.0, 10.0),
        ];
        let start = self.start.map(|q| ("start", q, -5.0, 5.0));
        // NaN is in no range.
        let outside = settings.into_iter().chain(start).find(|(_, value, low, high)| !(low..=high).contains(&value));
        outside.map_or(Ok(()), |(field, value, low, high)| Err(FakeError::OutOfRange { field, value, low, high }))
    }
}
