//! Encodes commands to the motors as datagrams of the DDS wire protocol.
//!
//! The control loop and the [watchdog](crate::watchdog) send these themselves. No thread and no queue of a DDS library is
//! between a decision and the network, and nothing that arrives from the network can delay it. RustDDS only announces
//! the writer, so that the robot accepts what it sends.

/// First sequence number of the watchdog. The control loop would need 70 years to reach it.
pub const FIRST_NUMBER: u64 = 1 << 40;
/// Size of the largest payload of a command [bytes].
pub const MAX_PAYLOAD: usize = 1024;
/// Size of header, DATA submessage before its payload, and HEARTBEAT submessage [bytes].
const OVERHEAD: usize = 20 + 24 + 32;
/// Size of the largest datagram [bytes].
pub const MAX_DATAGRAM: usize = OVERHEAD + MAX_PAYLOAD;

/// Globally unique id of a DDS writer: 12 bytes of its participant, 4 of its own (RTPS 2.5, 8.2.4).
pub type WriterGuid = [u8; 16];

/// A datagram with one command. Changing its number or its payload allocates nothing.
#[derive(Clone)]
pub struct CommandDatagram {
    bytes: [u8; MAX_DATAGRAM],
    len: usize,
}

impl CommandDatagram {
    /// Returns a datagram of `writer` with the payload of a command: header and body, at most [`MAX_PAYLOAD`] bytes, a multiple
    /// of four. `None` if it is not.
    pub fn new(writer: WriterGuid, payload: &[u8]) -> Option<Self> {
        if payload.len() > MAX_PAYLOAD || !payload.len().is_multiple_of(4) {
            return None;
        }
        let mut bytes = [0; MAX_DATAGRAM];
        let mut end = 0;
        let mut put = |part: &[u8]| {
            bytes[end..end + part.len()].copy_from_slice(part);
            end += part.len();
        };
        // Header: protocol 2.4, vendor id of RustDDS, whose participant announces the writer (RTPS 2.5, 9.4.4).
        put(b"RTPS");
        put(&[2, 4, 1, 18]);
        put(&writer[..12]);
        // DATA, little-endian, with a payload, for every reader of the writer (9.4.5.4).
        put(&[0x15, 0b0101]);
        put(&(20 + payload.len() as u16).to_le_bytes());
        put(&[0, 0, 16, 0]);
        put(&[0; 4]);
        put(&writer[12..]);
        put(&[0; 8]);
        put(payload);
        // HEARTBEAT, little-endian, final: earlier commands are gone, and nobody has to answer (9.4.5.7). Without it a
        // reliable reader would wait for every command that was lost.
        put(&[0x07, 0b0011, 28, 0]);
        put(&[0; 4]);
        put(&writer[12..]);
        put(&[0; 20]);
        Some(Self { bytes, len: end })
    }

    /// Returns the datagram with its next sequence number and a payload of the size of the first one.
    pub fn with_payload(&mut self, number: u64, payload: &[u8]) -> &[u8] {
        let size = self.len - OVERHEAD;
        if payload.len() == size {
            self.bytes[44..44 + size].copy_from_slice(payload);
        }
        self.with_number(number)
    }

    /// Returns the datagram with a sequence number.
    pub fn with_number(&mut self, number: u64) -> &[u8] {
        let heartbeat = self.len - 32;
        self.put_number(36, number);
        self.put_number(heartbeat + 12, number);
        self.put_number(heartbeat + 20, number);
        self.bytes[heartbeat + 28..heartbeat + 32].copy_from_slice(&heartbeat_count(number).to_le_bytes());
        &self.bytes[..self.len]
    }

    /// Writes a sequence number: its high, then its low half.
    fn put_number(&mut self, at: usize, number: u64) {
        self.bytes[at..at + 4].copy_from_slice(&((number >> 32) as u32).to_le_bytes());
        self.bytes[at + 4..at + 8].copy_from_slice(&(number as u32).to_le_bytes());
    }
}

/// Returns the count of the heartbeat of a command. Readers ignore a heartbeat whose count is not larger than that of the last
/// one (the count of a Heartbeat in RTPS 2.5, 8.3.8), so the watchdog's have to follow those of the control loop.
fn heartbeat_count(number: u64) -> u32 {
    const HALF: u64 = 1 << 30;
    let half = if number < FIRST_NUMBER { 0 } else { HALF };
    (half + number % HALF) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    const WRITER: WriterGuid = [1, 18, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 0, 0, 1, 3];

    #[test]
    fn bytes_are_those_of_the_standard() {
        let mut datagram = CommandDatagram::new(WRITER, &[0, 1, 0, 0, 7, 7, 7, 7]).expect("a payload");
        let bytes = datagram.with_number((1 << 40) + 5);
        #[rustfmt::skip]
        let expected = [
            b'R', b'T', b'P', b'S', 2, 4, 1, 18, 1, 18, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11,
            0x15, 5, 28, 0, 0, 0, 16, 0, 0, 0, 0, 0, 0, 0, 1, 3, 0, 1, 0, 0, 5, 0, 0, 0, 0, 1, 0, 0, 7, 7, 7, 7,
            0x07, 3, 28, 0, 0, 0, 0, 0, 0, 0, 1, 3, 0, 1, 0, 0, 5, 0, 0, 0, 0, 1, 0, 0, 5, 0, 0, 0, 5, 0, 0, 64,
        ];
        assert_eq!(bytes, expected);
    }

    #[test]
    fn payload_and_number_of_the_next_command_replace_those_of_the_last() {
        let mut datagram = CommandDatagram::new(WRITER, &[0, 1, 0, 0, 7, 7, 7, 7]).expect("a payload");
        datagram.with_number(1);
        let bytes = datagram.with_payload(2, &[0, 1, 0, 0, 8, 8, 8, 8]).to_vec();
        assert_eq!((&bytes[40..44], &bytes[48..52]), (&[2, 0, 0, 0][..], &[8; 4][..]));
        assert_eq!(bytes[bytes.len() - 4..], [2, 0, 0, 0], "the second heartbeat");
    }

    #[test]
    fn heartbeats_of_the_watchdog_are_counted_on_after_those_of_the_control_loop() {
        let day = 24 * 3600 * 500;
        assert!(heartbeat_count(1) < heartbeat_count(day) && heartbeat_count(day) < heartbeat_count(FIRST_NUMBER));
        assert!(heartbeat_count(FIRST_NUMBER) < heartbeat_count(FIRST_NUMBER + 1));
    }

    #[test]
    fn payload_that_is_too_large_or_not_aligned_is_refused() {
        assert!(CommandDatagram::new(WRITER, &[0; MAX_PAYLOAD + 4]).is_none());
        assert!(CommandDatagram::new(WRITER, &[0; 5]).is_none());
    }
}
