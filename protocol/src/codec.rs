//! Encodes messages to MessagePack and decodes them.

use serde::{Deserialize, Serialize};

use crate::error::{ErrorCode, ErrorReply};
use crate::version::PROTOCOL;

#[derive(Deserialize)]
struct Version {
    protocol: u16,
}

/// Encodes a message as a MessagePack map with field names.
pub fn encode(message: &impl Serialize) -> Vec<u8> {
    encode_with_capacity(message, 256)
}

/// Encodes a message like [`encode`], into a buffer of `capacity` bytes.
///
/// A sufficient capacity avoids reallocations, each of which copies a large message.
pub fn encode_with_capacity(message: &impl Serialize, capacity: usize) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(capacity);
    message
        .serialize(&mut rmp_serde::Serializer::new(&mut bytes).with_struct_map())
        .expect("messages hold only numbers, strings and bytes, which always encode");
    bytes
}

/// Decodes a message.
///
/// The error code is [`ErrorCode::Version`] for another protocol version, else [`ErrorCode::Malformed`].
pub fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, ErrorReply> {
    // Serde would also accept fields by position, whose order is not specified.
    if !matches!(bytes.first(), Some(0x80..=0x8f | 0xde | 0xdf)) {
        return Err(malformed("the message is not a MessagePack map"));
    }
    rmp_serde::from_slice(bytes).map_err(|error| match rmp_serde::from_slice::<Version>(bytes) {
        Ok(Version { protocol }) if protocol != PROTOCOL => ErrorReply::version(protocol),
        _ => malformed(&error.to_string()),
    })
}

fn malformed(reason: &str) -> ErrorReply {
    ErrorReply::new(ErrorCode::Malformed, "", reason).with_hint("encode one MessagePack map with the fields in SPEC.md")
}
