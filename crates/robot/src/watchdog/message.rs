//! Messages between control loop and watchdog, one per datagram of their socket pair.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use super::Mode;
use crate::command_datagram::{MAX_PAYLOAD, WriterGuid};

/// Maximum number of addresses to which a command is sent.
pub const MAX_READERS: usize = 8;
/// Size of the largest message [bytes].
pub const MAX_MESSAGE: usize = 1 + 4 + 16 + 1 + 6 * MAX_READERS + MAX_PAYLOAD;

/// The writer that is guarded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Guard<'a> {
    /// Number of the writer, counted from one.
    pub generation: u32,
    /// Its id.
    pub writer: WriterGuid,
    /// Addresses of its readers, at most [`MAX_READERS`], IPv4.
    pub readers: &'a [SocketAddr],
    /// Payload of a damping command.
    pub damping: &'a [u8],
}

/// Message of the control loop.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Message<'a> {
    /// Begins to guard a writer, or replaces the addresses of its readers.
    Guard {
        /// Number of the writer.
        generation: u32,
        /// Its id.
        writer: WriterGuid,
        /// Encoded addresses, six bytes each.
        readers: &'a [u8],
        /// Payload of a damping command.
        damping: &'a [u8],
    },
    /// A command was sent.
    Beat {
        /// Number of the writer.
        generation: u32,
    },
    /// The robot is not armed any more.
    Release,
}

/// Message of the watchdog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status {
    /// Number of the last writer that was guarded.
    pub generation: u32,
    /// True while it damps the motors.
    pub has_taken_over: bool,
}

impl Guard<'_> {
    /// Writes the message into `buffer` and returns its size. `None` if it is too large.
    pub fn encode(&self, buffer: &mut [u8; MAX_MESSAGE]) -> Option<usize> {
        if self.readers.len() > MAX_READERS || self.damping.len() > MAX_PAYLOAD {
            return None;
        }
        let mut end = 0;
        let mut put = |part: &[u8]| {
            buffer[end..end + part.len()].copy_from_slice(part);
            end += part.len();
        };
        put(b"G");
        put(&self.generation.to_le_bytes());
        put(&self.writer);
        put(&[self.readers.len() as u8]);
        for reader in self.readers {
            let IpAddr::V4(address) = reader.ip() else { return None };
            put(&address.octets());
            put(&reader.port().to_le_bytes());
        }
        put(self.damping);
        Some(end)
    }
}

/// Returns the message that a command was sent.
pub fn encode_beat(generation: u32) -> [u8; 5] {
    let [a, b, c, d] = generation.to_le_bytes();
    [b'B', a, b, c, d]
}

/// The message that the robot is not armed any more.
pub const RELEASE: &[u8] = b"R";

impl<'a> Message<'a> {
    /// Decodes a message. `None` if it is none.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let (kind, rest) = bytes.split_first()?;
        match kind {
            b'G' => {
                let (generation, rest) = rest.split_first_chunk::<4>()?;
                let (writer, rest) = rest.split_first_chunk::<16>()?;
                let (readers, rest) = rest.split_first()?;
                let (readers, damping) = rest.split_at_checked(6 * usize::from(*readers))?;
                Some(Self::Guard { generation: u32::from_le_bytes(*generation), writer: *writer, readers, damping })
            }
            b'B' => Some(Self::Beat { generation: u32::from_le_bytes(*rest.first_chunk()?) }),
            b'R' => Some(Self::Release),
            _ => None,
        }
    }
}

/// Decodes addresses of readers.
pub fn decode_readers(bytes: &[u8]) -> impl Iterator<Item = SocketAddr> + '_ {
    bytes.chunks_exact(6).map(|reader| {
        let address = Ipv4Addr::new(reader[0], reader[1], reader[2], reader[3]);
        SocketAddr::new(IpAddr::V4(address), u16::from_le_bytes([reader[4], reader[5]]))
    })
}

impl Status {
    /// Returns the status of a watchdog.
    pub fn new(mode: Mode, generation: u32) -> Self {
        Self { generation, has_taken_over: mode == Mode::TakeOver }
    }

    /// Encodes the status.
    pub fn encode(self) -> [u8; 5] {
        let [a, b, c, d] = self.generation.to_le_bytes();
        [u8::from(self.has_taken_over), a, b, c, d]
    }

    /// Decodes a status. `None` if it is none.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (has_taken_over, generation) = bytes.split_first()?;
        Some(Self { has_taken_over: *has_taken_over == 1, generation: u32::from_le_bytes(*generation.first_chunk()?) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_survive_the_socket() {
        let readers = ["192.168.123.161:7411".parse().expect("an address"), "127.0.0.1:9".parse().expect("an address")];
        let guard = Guard { generation: 3, writer: [7; 16], readers: &readers, damping: &[1, 2, 3] };
        let mut buffer = [0; MAX_MESSAGE];
        let len = guard.encode(&mut buffer).expect("it fits");
        let Some(Message::Guard { generation: 3, writer, readers: encoded, damping: [1, 2, 3] }) =
            Message::decode(&buffer[..len])
        else {
            panic!("not the message")
        };
        assert_eq!(writer, [7; 16]);
        assert_eq!(decode_readers(encoded).collect::<Vec<_>>(), readers);
        assert_eq!(Message::decode(&encode_beat(9)), Some(Message::Beat { generation: 9 }));
        assert_eq!(Message::decode(RELEASE), Some(Message::Release));
        let status = Status::new(Mode::TakeOver, 4);
        assert_eq!(Status::decode(&status.encode()), Some(status));
    }

    #[test]
    fn broken_messages_are_none() {
        for bytes in [&b""[..], b"X", b"B12", b"G\x01\0\0\0", &[&b"G"[..], &[0; 20], &[9]].concat()] {
            assert_eq!(Message::decode(bytes), None, "{bytes:?}");
        }
    }
}
