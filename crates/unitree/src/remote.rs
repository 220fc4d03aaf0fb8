//! The remote control in [`crate::LowState::wireless_remote`].

/// The bytes of the remote control in a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RemoteBytes(pub [u8; 40]);

impl Default for RemoteBytes {
    fn default() -> Self {
        Self([0; 40])
    }
}

/// State of the remote control.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Remote {
    /// Pressed buttons, one bit for each [`Button`].
    pub keys: u16,
    /// Left stick, −1 left to +1 right.
    pub lx: f32,
    /// Left stick, −1 backward to +1 forward.
    pub ly: f32,
    /// Right stick, −1 left to +1 right.
    pub rx: f32,
    /// Right stick, −1 backward to +1 forward.
    pub ry: f32,
    /// Left trigger, 0 to 1.
    pub l2: f32,
}

/// Button of the remote control; the value is its bit in [`Remote::keys`].
#[allow(missing_docs, reason = "the names on the remote control")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Button {
    R1,
    L1,
    Start,
    Select,
    R2,
    L2,
    F1,
    F2,
    A,
    B,
    X,
    Y,
    Up,
    Right,
    Down,
    Left,
}

impl Remote {
    /// Returns the state, or `None` if all bytes are zero: no remote is received.
    pub fn decode(RemoteBytes(bytes): &RemoteBytes) -> Option<Self> {
        if bytes.iter().all(|byte| *byte == 0) {
            return None;
        }
        let float = |at: usize| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        Some(Self {
            keys: u16::from_le_bytes([bytes[2], bytes[3]]),
            lx: float(4),
            rx: float(8),
            ry: float(12),
            l2: float(16),
            ly: float(20),
        })
    }

    /// Returns the bytes in a message.
    pub fn encode(&self) -> RemoteBytes {
        let mut bytes = [0; 40];
        bytes[..2].copy_from_slice(&HEAD);
        bytes[2..4].copy_from_slice(&self.keys.to_le_bytes());
        for (index, value) in [self.lx, self.rx, self.ry, self.l2, self.ly].into_iter().enumerate() {
            bytes[4 + 4 * index..8 + 4 * index].copy_from_slice(&value.to_le_bytes());
        }
        RemoteBytes(bytes)
    }

    /// Returns true if `button` is pressed.
    pub fn is_pressed(&self, button: Button) -> bool {
        self.keys >> button as u16 & 1 == 1
    }

    /// Returns the state with `button` pressed.
    pub fn with_pressed(mut self, button: Button) -> Self {
        self.keys |= 1 << button as u16;
        self
    }
}

/// First two bytes. Their value is not documented; zero is that of a remote that is not received.
const HEAD: [u8; 2] = [0x55, 0x51];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn state_round_trips() {
        let remote = Remote { lx: 0.1, ly: -0.2, rx: 0.3, ry: -0.4, l2: 0.5, keys: 0 };
        let remote = remote.with_pressed(Button::L2).with_pressed(Button::B);
        let bytes = remote.encode();
        assert_eq!(Remote::decode(&bytes), Some(remote));
        assert_eq!(bytes.0[2..4], [0b10_0000, 0b10], "bits 5 and 9");
        assert_eq!(bytes.0[20..24], (-0.2_f32).to_le_bytes());
        assert!(remote.is_pressed(Button::L2) && remote.is_pressed(Button::B) && !remote.is_pressed(Button::A));
    }

    #[test]
    fn zeros_are_no_remote() {
        assert_eq!(Remote::decode(&RemoteBytes::default()), None);
        assert_eq!(Remote::decode(&Remote::default().encode()), Some(Remote::default()));
    }
}
