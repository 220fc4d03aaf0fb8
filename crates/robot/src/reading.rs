//! What the safety state machine uses of a `LowState`, in the order of the policy's joints.

use twinstep_model::{Joint, PerJoint, frames};
use twinstep_unitree::{ChecksumError, LowState, Remote, motor_index};

/// Measurements of the robot; joints in the order of [`Joint::ALL`].
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Counter of the robot's clock.
    pub tick: u32,
    /// Joint position [rad].
    pub q: PerJoint,
    /// Joint velocity [rad/s].
    pub dq: PerJoint,
    /// Torque estimated from the motor current [N·m].
    pub tau: PerJoint,
    /// Motor temperature [°C].
    ///
    /// The vendor's two definitions of the message disagree about its sign. It counts as unsigned: a motor that is too hot must
    /// not count as cold.
    pub temperature: [u8; 12],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Angular velocity of the base in the base frame [rad/s].
    pub gyro: [f32; 3],
    /// Specific force in the base frame, +9.81 m/s² upward at rest [m/s²].
    pub acc: [f32; 3],
    /// Angle between the trunk's z axis and the vertical [rad].
    pub tilt: f32,
    /// Supply voltage [V].
    pub voltage: f32,
    /// Charge of the battery [%].
    pub charge: u8,
    /// Messages lost between main board and motors since the robot was switched on, sum over the joints.
    pub lost_messages: u32,
    /// Remote control; `None` if it is not received.
    pub remote: Option<Remote>,
}

/// Largest number of an IMU that can be true [m/s², rad/s]. Sensors of robots end at 160 m/s² and 35 rad/s.
const MAX_IMU: f32 = 1000.0;

/// A message of the robot cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ReadingError {
    /// The message was damaged.
    #[error("the message is damaged: {0}")]
    Checksum(#[from] ChecksumError),
    /// A number is not finite.
    #[error("`{quantity}` of {joint} is {value}, which is not a finite number")]
    NotFinite {
        /// Joint.
        joint: Joint,
        /// Field of the message.
        quantity: &'static str,
        /// Value of the field.
        value: f32,
    },
    /// A number of the IMU is not finite, or beyond every sensor's range.
    #[error("`{quantity}` of the IMU is {value:?}, which no sensor measures")]
    Imu {
        /// Field of the message.
        quantity: &'static str,
        /// Value of the field.
        value: [f32; 3],
    },
    /// The orientation is not a rotation.
    #[error("the orientation {0:?} has not the length 1 of a rotation")]
    Orientation([f32; 4]),
    /// The voltage is not finite.
    #[error("the supply voltage is {0}, which is not a finite number")]
    Voltage(f32),
}

impl Reading {
    /// Returns the measurements of a message whose checksum is right.
    pub fn new(state: &LowState) -> Result<Self, ReadingError> {
        state.check_checksum()?;
        let motors = Joint::ALL.map(|joint| state.motor_state[motor_index(joint)]);
        for (joint, motor) in Joint::ALL.into_iter().zip(motors) {
            let fields = [("q", motor.q), ("dq", motor.dq), ("tau_est", motor.tau_est)];
            if let Some((quantity, value)) = fields.into_iter().find(|(_, value)| !value.is_finite()) {
                return Err(ReadingError::NotFinite { joint, quantity, value });
            }
        }
        let orientation = state.imu_state.quaternion;
        let length = orientation.iter().map(|part| part * part).sum::<f32>().sqrt();
        if !(0.9..1.1).contains(&length) {
            return Err(ReadingError::Orientation(orientation));
        }
        let imu = [("gyroscope", state.imu_state.gyroscope), ("accelerometer", state.imu_state.accelerometer)];
        for (quantity, value) in imu {
            if value.iter().any(|part| !(..=MAX_IMU).contains(&part.abs())) {
                return Err(ReadingError::Imu { quantity, value });
            }
        }
        if !state.power_v.is_finite() {
            return Err(ReadingError::Voltage(state.power_v));
        }
        Ok(Self {
            tick: state.tick,
            q: motors.map(|motor| motor.q),
            dq: motors.map(|motor| motor.dq),
            tau: motors.map(|motor| motor.tau_est),
            temperature: motors.map(|motor| motor.temperature),
            orientation: orientation.map(|part| part / length),
            gyro: state.imu_state.gyroscope,
            acc: state.imu_state.accelerometer,
            tilt: (-frames::projected_gravity(orientation.map(|part| part / length)).z).clamp(-1.0, 1.0).acos(),
            voltage: state.power_v,
            charge: state.bms_state.soc,
            lost_messages: motors.iter().fold(0, |sum, motor| sum.wrapping_add(motor.lost)),
            remote: Remote::decode(&state.wireless_remote),
        })
    }
}

#[cfg(test)]
mod tests {
    use twinstep_unitree::{ImuState, MotorState};

    use super::*;

    fn upright() -> LowState {
        let imu_state = ImuState { quaternion: [1.0, 0.0, 0.0, 0.0], ..ImuState::default() };
        let motor = |index: usize| MotorState { q: index as f32, temperature: 30, lost: 2, ..MotorState::default() };
        LowState { imu_state, motor_state: std::array::from_fn(motor), power_v: 29.0, ..LowState::default() }
    }

    #[test]
    fn joints_are_in_the_order_of_the_policy() {
        let reading = Reading::new(&upright().with_checksum()).expect("a reading");
        assert_eq!(reading.q, [3.0, 4.0, 5.0, 0.0, 1.0, 2.0, 9.0, 10.0, 11.0, 6.0, 7.0, 8.0]);
        assert_eq!((reading.tilt, reading.lost_messages, reading.remote), (0.0, 24, None));
    }

    #[test]
    fn tilt_is_the_angle_to_the_vertical() {
        for (quaternion, tilt) in [([0.5_f32.sqrt(), 0.5_f32.sqrt(), 0.0, 0.0], 90.0), ([0.0, 0.0, 1.0, 0.0], 180.0)] {
            let mut state = upright();
            state.imu_state.quaternion = quaternion;
            let reading = Reading::new(&state.with_checksum()).expect("a reading");
            assert!((reading.tilt.to_degrees() - tilt).abs() < 0.1, "{}", reading.tilt.to_degrees());
        }
    }

    #[test]
    fn damaged_or_impossible_message_is_rejected() {
        assert!(matches!(Reading::new(&upright()), Err(ReadingError::Checksum(_))));
        let change: [fn(&mut LowState); 6] = [
            |state| state.motor_state[4].dq = f32::NAN,
            |state| state.imu_state.quaternion = [0.0; 4],
            |state| state.imu_state.quaternion[2] = f32::NAN,
            |state| state.power_v = f32::INFINITY,
            |state| state.imu_state.gyroscope[1] = f32::NAN,
            |state| state.imu_state.accelerometer[2] = 3e38,
        ];
        let errors = change.map(|change| {
            let mut state = upright();
            change(&mut state);
            Reading::new(&state.with_checksum()).expect_err("impossible").to_string()
        });
        assert!(errors[0].starts_with("`dq` of FL_thigh is NaN"), "{}", errors[0]);
        assert!(errors[1].contains("orientation") && errors[2].contains("orientation"));
        assert!(errors[3].contains("voltage") && errors[4].contains("gyroscope"));
        assert!(errors[5].contains("accelerometer"), "{}", errors[5]);
    }
}
