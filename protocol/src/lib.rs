//! The wire protocol `twinstep.v1`: messages, key expressions, errors. `SPEC.md` next to this crate's manifest is the
//! specification for clients in other languages.
//!
//! - [`keys`]: key expressions of requests and liveliness tokens.
//! - [`message`]: one struct per message, encoded as a MessagePack map; tensors are `bin` (little-endian, C order).
//! - [`ErrorReply`] and [`ErrorCode`]: error replies.
//! - [`Secret`]: what a client attaches to its requests, so that no other client can use its environments.
//! - [`encode`] and [`decode`]: messages to and from bytes. An unsupported protocol version is an error of its own.
//! - [`stop_channel`]: how a robot is stopped beside Zenoh.
//! - [`convert`]: conversions between messages and the types of `twinstep-model`.

mod codec;
pub mod convert;
mod error;
pub mod keys;
pub mod message;
mod random;
pub mod stop_channel;
pub mod tensor;
mod version;

pub use codec::{decode, encode};
pub use error::{ErrorCode, ErrorReply};
pub use random::{ParseSecretError, SECRET_BYTES, Secret, random_id, random_u64};
pub use version::PROTOCOL;
