//! Messages to bytes and back.

use serde::{Deserialize, Serialize};

use crate::{Code, WireError};

/// The version of the protocol that this crate speaks.
pub const PROTOCOL: u16 = 1;

#[derive(Deserialize)]
struct Version {
    protocol: u16,
}

/// A message as MessagePack, a map with field names.
pub fn encode(message: &impl Serialize) -> Vec<u8> {
    rmp_serde::to_vec_named(message).expect("messages hold only numbers, strings and bytes, which always encode")
}

/// Reads a message; the error says whether the version is foreign or the bytes are not the message.
pub fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, WireError> {
    rmp_serde::from_slice(bytes).map_err(|error| match rmp_serde::from_slice::<Version>(bytes) {
        Ok(Version { protocol }) if protocol != PROTOCOL => WireError::version(protocol),
        _ => WireError::new(Code::Malformed, "", error.to_string())
            .with_hint("a request is one MessagePack map with the fields of SPEC.md"),
    })
}
