//! `LowState_`: measurements of the robot, on `rt/lowstate`.

use crate::cdr::{FieldVisitor, Message};
use crate::imu_state::ImuState;
use crate::motor_order::NUM_MOTORS;
use crate::remote::RemoteBytes;

/// Measurements of the robot; motors and feet in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LowState {
    /// [`crate::HEAD`].
    pub head: [u8; 2],
    /// [`crate::LOW_LEVEL`].
    pub level_flag: u8,
    /// Not used.
    pub frame_reserve: u8,
    /// Serial number of the robot.
    pub sn: [u32; 2],
    /// Version of the firmware.
    pub version: [u32; 2],
    /// Not used.
    pub bandwidth: u16,
    /// Inertial measurement unit.
    pub imu_state: ImuState,
    /// State of each motor.
    pub motor_state: [MotorState; NUM_MOTORS],
    /// State of the battery.
    pub bms_state: BmsState,
    /// Raw counts of the force sensors in the feet, not newtons.
    pub foot_force: [i16; 4],
    /// Estimated counts of the force sensors in the feet.
    pub foot_force_est: [i16; 4],
    /// Counter of the main board's clock.
    pub tick: u32,
    /// State of the remote control ([`crate::Remote`]).
    pub wireless_remote: RemoteBytes,
    /// Flags of the main board.
    pub bit_flag: u8,
    /// Reading of the cable reel.
    pub adc_reel: f32,
    /// Temperature of the main board, first sensor [°C].
    pub temperature_ntc1: u8,
    /// Temperature of the main board, second sensor [°C].
    pub temperature_ntc2: u8,
    /// Supply voltage [V].
    pub power_v: f32,
    /// Supply current [A].
    pub power_a: f32,
    /// Speed of the fans.
    pub fan_frequency: [u16; 4],
    /// Not used.
    pub reserve: u32,
    /// Checksum of the fields before it ([`crate::crc`]).
    pub crc: u32,
}

/// Measurements of one motor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotorState {
    /// [`crate::SERVO`], or 0 for a stopped motor.
    pub mode: u8,
    /// Joint position [rad].
    pub q: f32,
    /// Joint velocity [rad/s].
    pub dq: f32,
    /// Joint acceleration [rad/s²].
    pub ddq: f32,
    /// Motor current × torque constant [N·m].
    pub tau_est: f32,
    /// Position before the firmware's filter [rad].
    pub q_raw: f32,
    /// Velocity before the firmware's filter [rad/s].
    pub dq_raw: f32,
    /// Acceleration before the firmware's filter [rad/s²].
    pub ddq_raw: f32,
    /// Motor temperature, a signed number in two's complement [°C].
    pub temperature: u8,
    /// Number of lost messages between main board and motor.
    pub lost: u32,
    /// Not used.
    pub reserve: [u32; 2],
}

/// State of the battery.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BmsState {
    /// Major version of the battery's firmware.
    pub version_high: u8,
    /// Minor version of the battery's firmware.
    pub version_low: u8,
    /// Status code.
    pub status: u8,
    /// State of charge [%].
    pub soc: u8,
    /// Current [mA].
    pub current: i32,
    /// Number of charge cycles.
    pub cycle: u16,
    /// Temperatures of the battery [°C].
    pub bq_ntc: [u8; 2],
    /// Temperatures of the battery's controller [°C].
    pub mcu_ntc: [u8; 2],
    /// Cell voltages [mV].
    pub cell_vol: [u16; 15],
}

impl Message for LowState {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.array(&mut self.head);
        fields.value(&mut self.level_flag);
        fields.value(&mut self.frame_reserve);
        fields.array(&mut self.sn);
        fields.array(&mut self.version);
        fields.value(&mut self.bandwidth);
        fields.structure(&mut self.imu_state);
        for motor in &mut self.motor_state {
            fields.structure(motor);
        }
        fields.structure(&mut self.bms_state);
        fields.array(&mut self.foot_force);
        fields.array(&mut self.foot_force_est);
        fields.value(&mut self.tick);
        fields.array(&mut self.wireless_remote.0);
        fields.value(&mut self.bit_flag);
        fields.value(&mut self.adc_reel);
        fields.value(&mut self.temperature_ntc1);
        fields.value(&mut self.temperature_ntc2);
        fields.value(&mut self.power_v);
        fields.value(&mut self.power_a);
        fields.array(&mut self.fan_frequency);
        fields.value(&mut self.reserve);
        fields.value(&mut self.crc);
    }
}

impl Message for MotorState {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.mode);
        fields.value(&mut self.q);
        fields.value(&mut self.dq);
        fields.value(&mut self.ddq);
        fields.value(&mut self.tau_est);
        fields.value(&mut self.q_raw);
        fields.value(&mut self.dq_raw);
        fields.value(&mut self.ddq_raw);
        fields.value(&mut self.temperature);
        fields.value(&mut self.lost);
        fields.array(&mut self.reserve);
    }
}

impl Message for BmsState {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.version_high);
        fields.value(&mut self.version_low);
        fields.value(&mut self.status);
        fields.value(&mut self.soc);
        fields.value(&mut self.current);
        fields.value(&mut self.cycle);
        fields.array(&mut self.bq_ntc);
        fields.array(&mut self.mcu_ntc);
        fields.array(&mut self.cell_vol);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::{distinct, encode, round_trips};

    #[test]
    fn every_field_round_trips() {
        round_trips::<LowState>(1176);
    }

    /// Offsets in the body: 22 bytes of head, 53 bytes of IMU from 24, mode of the first motor at 77, its q at 80.
    #[test]
    fn fields_are_at_the_offsets_of_the_idl() {
        let state = distinct::<LowState>(1176);
        let body = &encode(&state)[4..];
        assert_eq!(body.len(), 1176);
        assert_eq!(body[24..28], state.imu_state.quaternion[0].to_le_bytes());
        assert_eq!(body[76], state.imu_state.temperature);
        assert_eq!(body[77], state.motor_state[0].mode);
        assert_eq!(body[80..84], state.motor_state[0].q.to_le_bytes());
        assert_eq!(body[1080..1082], state.foot_force[0].to_le_bytes());
        assert_eq!(body[1152..1156], state.power_v.to_le_bytes());
        assert_eq!(body[1172..1176], state.crc.to_le_bytes());
    }
}
