//! `WirelessController_`: the remote control, on `rt/wirelesscontroller`.

use crate::cdr::{FieldVisitor, Message};

/// State of the remote control. The same is in [`crate::LowState::wireless_remote`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WirelessController {
    /// Left stick, −1 left to +1 right.
    pub lx: f32,
    /// Left stick, −1 backward to +1 forward.
    pub ly: f32,
    /// Right stick, −1 left to +1 right.
    pub rx: f32,
    /// Right stick, −1 backward to +1 forward.
    pub ry: f32,
    /// Pressed buttons, one bit for each [`crate::Button`].
    pub keys: u16,
}

impl Message for WirelessController {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.lx);
        fields.value(&mut self.ly);
        fields.value(&mut self.rx);
        fields.value(&mut self.ry);
        fields.value(&mut self.keys);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_round_trips() {
        crate::cdr::round_trips::<WirelessController>(18);
    }
}
