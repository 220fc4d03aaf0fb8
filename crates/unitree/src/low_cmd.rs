//! `LowCmd_`: command of the robot, on `rt/lowcmd`.

use crate::cdr::{FieldVisitor, Message};
use crate::motor_order::NUM_MOTORS;
use crate::remote::RemoteBytes;

/// Commanded position that disables the position loop [rad].
pub const NO_POSITION: f32 = 2.146e9;
/// Commanded velocity that disables the velocity loop [rad/s].
pub const NO_VELOCITY: f32 = 16_000.0;
/// First two bytes of a message.
pub const HEAD: [u8; 2] = [0xfe, 0xef];
/// `level_flag` of a message to or from the motors.
pub const LOW_LEVEL: u8 = 0xff;
/// `mode` of a motor in servo control; 0 stops the motor.
pub const SERVO: u8 = 1;

/// Command of the robot; motors in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LowCmd {
    /// [`HEAD`].
    pub head: [u8; 2],
    /// [`LOW_LEVEL`].
    pub level_flag: u8,
    /// Not used.
    pub frame_reserve: u8,
    /// Serial number of the robot.
    pub sn: [u32; 2],
    /// Version of the firmware.
    pub version: [u32; 2],
    /// Not used.
    pub bandwidth: u16,
    /// Command of each motor.
    pub motor_cmd: [MotorCmd; NUM_MOTORS],
    /// Command of the battery.
    pub bms_cmd: BmsCmd,
    /// Not used.
    pub wireless_remote: RemoteBytes,
    /// Lights.
    pub led: [u8; 12],
    /// Fans.
    pub fan: [u8; 2],
    /// Outputs of the main board.
    pub gpio: u8,
    /// Not used.
    pub reserve: u32,
    /// Checksum of the fields before it ([`crate::crc`]).
    pub crc: u32,
}

/// Command of one motor: torque = tau + kp·(q − q_measured) + kd·(dq − dq_measured).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotorCmd {
    /// [`SERVO`], or 0 to stop the motor.
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
    /// Not used.
    pub reserve: [u32; 3],
}

/// Command of the battery.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BmsCmd {
    /// A5 switches the robot's power off.
    pub off: u8,
    /// Not used.
    pub reserve: [u8; 3],
}

impl LowCmd {
    /// Returns a message to the motors in which every motor is in servo control with gains of 0.
    ///
    /// Its checksum is not computed yet.
    pub fn stopped() -> Self {
        let motor = MotorCmd { mode: SERVO, q: NO_POSITION, dq: NO_VELOCITY, ..MotorCmd::default() };
        Self { head: HEAD, level_flag: LOW_LEVEL, motor_cmd: [motor; NUM_MOTORS], ..Self::default() }
    }
}

impl Message for LowCmd {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.array(&mut self.head);
        fields.value(&mut self.level_flag);
        fields.value(&mut self.frame_reserve);
        fields.array(&mut self.sn);
        fields.array(&mut self.version);
        fields.value(&mut self.bandwidth);
        for motor in &mut self.motor_cmd {
            fields.structure(motor);
        }
        fields.structure(&mut self.bms_cmd);
        fields.array(&mut self.wireless_remote.0);
        fields.array(&mut self.led);
        fields.array(&mut self.fan);
        fields.value(&mut self.gpio);
        fields.value(&mut self.reserve);
        fields.value(&mut self.crc);
    }
}

impl Message for MotorCmd {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.mode);
        fields.value(&mut self.q);
        fields.value(&mut self.dq);
        fields.value(&mut self.tau);
        fields.value(&mut self.kp);
        fields.value(&mut self.kd);
        fields.array(&mut self.reserve);
    }
}

impl Message for BmsCmd {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.off);
        fields.array(&mut self.reserve);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::{distinct, encode, round_trips};

    #[test]
    fn every_field_round_trips() {
        round_trips::<LowCmd>(808);
    }

    #[test]
    fn fields_are_at_the_offsets_of_the_idl() {
        let command = distinct::<LowCmd>(808);
        let body = &encode(&command)[4..];
        assert_eq!(body.len(), 808);
        assert_eq!(body[..4], [command.head[0], command.head[1], command.level_flag, command.frame_reserve]);
        assert_eq!(body[20..22], command.bandwidth.to_le_bytes());
        // The first motor begins right after the two bytes of `bandwidth`, the others at multiples of four.
        assert_eq!(body[22], command.motor_cmd[0].mode);
        assert_eq!(body[24..28], command.motor_cmd[0].q.to_le_bytes());
        assert_eq!(body[56], command.motor_cmd[1].mode);
        assert_eq!(body[740], command.bms_cmd.off);
        assert_eq!(body[744..784], command.wireless_remote.0);
        assert_eq!(body[804..808], command.crc.to_le_bytes());
    }
}
