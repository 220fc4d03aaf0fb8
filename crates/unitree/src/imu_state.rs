//! `IMUState_`: the inertial measurement unit.

use crate::cdr::{FieldVisitor, Message};

/// Readings of the inertial measurement unit in the trunk.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImuState {
    /// Orientation world-from-base: w, x, y, z.
    pub quaternion: [f32; 4],
    /// Angular velocity in the base frame [rad/s].
    pub gyroscope: [f32; 3],
    /// Specific force in the base frame [m/s²].
    pub accelerometer: [f32; 3],
    /// Roll, pitch, yaw [rad].
    pub rpy: [f32; 3],
    /// Temperature [°C].
    pub temperature: u8,
}

impl Message for ImuState {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.array(&mut self.quaternion);
        fields.array(&mut self.gyroscope);
        fields.array(&mut self.accelerometer);
        fields.array(&mut self.rpy);
        fields.value(&mut self.temperature);
    }
}
