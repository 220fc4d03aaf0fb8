//! Messages `LowState_` and `LowCmd_` of the Go2 (IDL module `unitree_go`), with the fields that a log needs.
//!
//! Source of the fields and their order: Unitree's IDL in unitree_sdk2 and unitree_sdk2_python, which agrees with the
//! `.msg` files of unitree_ros2.

use twinstep_model::{Joint, Leg, NUM_JOINTS};

use crate::cdr::{FieldVisitor, Message};

/// Number of motor entries in a message beyond the joints of the Go2.
const MOTORS_WITHOUT_JOINT: usize = 20 - NUM_JOINTS;
/// Commanded position that disables the position loop [rad].
pub(crate) const NO_POSITION: f32 = 2.146e9;
/// Commanded velocity that disables the velocity loop [rad/s].
pub(crate) const NO_VELOCITY: f32 = 16_000.0;
/// `mode` of a motor in servo control.
pub(crate) const SERVO: u8 = 1;

/// Legs and feet in the robot's order.
const ROBOT_LEGS: [Leg; 4] = [Leg::FR, Leg::FL, Leg::RR, Leg::RL];

/// Returns the index of a joint's motor in the robot's order.
pub(crate) fn motor(joint: Joint) -> usize {
    foot(joint.leg) * 3 + joint.kind as usize
}

/// Returns the index of a leg in the robot's order.
pub(crate) fn foot(leg: Leg) -> usize {
    ROBOT_LEGS.iter().position(|robot| *robot == leg).unwrap_or(0)
}

/// Measurements of the robot; motors and feet in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LowState {
    /// Orientation world-from-base: w, x, y, z.
    pub quaternion: [f32; 4],
    /// Angular velocity [rad/s].
    pub gyroscope: [f32; 3],
    /// Specific force [m/s²].
    pub accelerometer: [f32; 3],
    pub motors: [MotorState; NUM_JOINTS],
    /// Raw counts of the force sensors, not newtons.
    pub foot_force: [i16; 4],
    /// Battery voltage [V].
    pub power_v: f32,
}

/// Measurements of one motor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct MotorState {
    pub mode: u8,
    /// Joint position [rad].
    pub q: f32,
    /// Joint velocity [rad/s].
    pub dq: f32,
    /// Motor current × torque constant [N·m].
    pub tau_est: f32,
    /// Motor temperature [°C].
    pub temperature: u8,
}

/// Command of the robot; motors in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LowCmd {
    pub motors: [MotorCmd; NUM_JOINTS],
}

/// Command of one motor: torque = tau + kp·(q − q_measured) + kd·(dq − dq_measured).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct MotorCmd {
    pub mode: u8,
    /// Commanded position [rad].
    pub q: f32,
    /// Commanded velocity [rad/s].
    pub dq: f32,
    /// Feed-forward torque [N·m].
    pub tau: f32,
    /// Position gain [N·m/rad].
    pub kp: f32,
    /// Velocity gain [N·m·s/rad].
    pub kd: f32,
}

impl Message for LowState {
    const SIZE: usize = 1176;

    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        head(fields);
        fields.array(&mut self.quaternion);
        fields.array(&mut self.gyroscope);
        fields.array(&mut self.accelerometer);
        fields.unused::<f32>(3); // roll, pitch, yaw
        fields.unused::<u8>(1); // temperature of the IMU
        for motor in self.motors.iter_mut().chain(&mut [MotorState::default(); MOTORS_WITHOUT_JOINT]) {
            fields.value(&mut motor.mode);
            fields.value(&mut motor.q);
            fields.value(&mut motor.dq);
            fields.unused::<f32>(1); // ddq
            fields.value(&mut motor.tau_est);
            fields.unused::<f32>(3); // q_raw, dq_raw, ddq_raw
            fields.value(&mut motor.temperature);
            fields.unused::<u32>(3); // lost, reserve
        }
        // Battery: versions, status and charge; current; cycles; temperatures; cell voltages.
        fields.unused::<u8>(4);
        fields.unused::<i32>(1);
        fields.unused::<u16>(1);
        fields.unused::<u8>(4);
        fields.unused::<u16>(15);
        fields.array(&mut self.foot_force);
        fields.unused::<i16>(4); // foot_force_est
        fields.unused::<u32>(1); // tick
        fields.unused::<u8>(40 + 1); // wireless_remote, bit_flag
        fields.unused::<f32>(1); // adc_reel
        fields.unused::<u8>(2); // temperature_ntc1, temperature_ntc2
        fields.value(&mut self.power_v);
        fields.unused::<f32>(1); // power_a
        fields.unused::<u16>(4); // fan_frequency
        fields.unused::<u32>(2); // reserve, crc
    }
}

impl Message for LowCmd {
    const SIZE: usize = 808;

    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        head(fields);
        for motor in self.motors.iter_mut().chain(&mut [MotorCmd::default(); MOTORS_WITHOUT_JOINT]) {
            fields.value(&mut motor.mode);
            fields.value(&mut motor.q);
            fields.value(&mut motor.dq);
            fields.value(&mut motor.tau);
            fields.value(&mut motor.kp);
            fields.value(&mut motor.kd);
            fields.unused::<u32>(3);
        }
        fields.unused::<u8>(4); // battery: off, reserve
        fields.unused::<u8>(40 + 12 + 2 + 1); // wireless_remote, led, fan, gpio
        // The checksum is zero, so that a robot ignores commands replayed from a log.
        fields.unused::<u32>(2); // reserve, crc
    }
}

/// Visits the common first fields: head, level_flag, frame_reserve, serial number, version, bandwidth.
fn head(fields: &mut impl FieldVisitor) {
    fields.array(&mut [0xfe_u8, 0xef, 0xff, 0]);
    fields.unused::<u32>(4);
    fields.unused::<u16>(1);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::{decode, encode};

    /// Unitree's Cyclone DDS writes 4 bytes of header, and 1176 and 808 bytes of body.
    #[test]
    fn messages_have_the_same_size_as_those_of_the_vendor() {
        assert_eq!(encode(&mut LowState::default()).len(), 1180);
        assert_eq!(encode(&mut LowCmd::default()).len(), 812);
    }

    #[test]
    fn every_joint_has_its_own_motor() {
        let motors = Joint::ALL.map(motor);
        assert_eq!(motors, [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]);
        assert_eq!(Leg::ALL.map(foot), [1, 0, 3, 2]);
    }

    #[test]
    fn messages_with_unequal_numbers_round_trip() {
        let mut next = 0.0;
        let mut number = || {
            next += 1.0;
            next
        };
        let mut state = LowState {
            quaternion: [(); 4].map(|()| number()),
            gyroscope: [(); 3].map(|()| number()),
            accelerometer: [(); 3].map(|()| number()),
            motors: [(); NUM_JOINTS].map(|()| MotorState {
                mode: number() as u8,
                q: number(),
                dq: number(),
                tau_est: number(),
                temperature: number() as u8,
            }),
            foot_force: [-1, 2, -3, 4],
            power_v: number(),
        };
        let bytes = encode(&mut state);
        assert_eq!(decode(&bytes), Ok(state.clone()));
        // Offsets in the body: 22 bytes of head, 53 bytes of IMU from 24, mode of the first motor at 77, its q at 80.
        assert_eq!(bytes[4..8], [0xfe, 0xef, 0xff, 0]);
        assert_eq!(bytes[4 + 24..4 + 28], state.quaternion[0].to_le_bytes());
        assert_eq!(bytes[4 + 80..4 + 84], state.motors[0].q.to_le_bytes());
    }
}
