//! Messages to bytes and back.

use serde::{Deserialize, Serialize};

use crate::{ErrorCode, ErrorReply};

/// The version of the protocol that this crate speaks.
pub const PROTOCOL: u16 = 1;

#[derive(Deserialize)]
struct Version {
    protocol: u16,
}

/// A message as MessagePack, a map with field names.
pub fn encode(message: &impl Serialize) -> Vec<u8> {
    encode_with_capacity(message, 256)
}

/// As [`encode`], into `capacity` bytes taken at once: a large message that grows is copied each time.
pub fn encode_with_capacity(message: &impl Serialize, capacity: usize) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(capacity);
    message
        .serialize(&mut rmp_serde::Serializer::new(&mut bytes).with_struct_map())
        .expect("messages hold only numbers, strings and bytes, which always encode");
    bytes
}

/// Reads a message; the error says whether the version is foreign or the bytes are not the message.
pub fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, ErrorReply> {
    // Serde would also take fields by position, in an order that no document promises.
    if !matches!(bytes.first(), Some(0x80..=0x8f | 0xde | 0xdf)) {
        return Err(malformed("the bytes are no MessagePack map"));
    }
    rmp_serde::from_slice(bytes).map_err(|error| match rmp_serde::from_slice::<Version>(bytes) {
        Ok(Version { protocol }) if protocol != PROTOCOL => ErrorReply::version(protocol),
        _ => malformed(&error.to_string()),
    })
}

fn malformed(reason: &str) -> ErrorReply {
    ErrorReply::new(ErrorCode::Malformed, "", reason).with_hint("a message is one MessagePack map with the fields of SPEC.md")
}
