//! Version of the protocol.

/// Protocol version of this crate.
pub const PROTOCOL: u16 = 1;
