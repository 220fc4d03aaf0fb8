//! The wire `twinstep.v1`: messages, key expressions, version check, golden bytes. `SPEC.md` beside this crate's
//! manifest says it all for a client in another language.
//!
//! - [`keys`]: where things are asked for.
//! - [`message`]: one struct a message, MessagePack as named maps, tensors as `bin` (little-endian, C order).
//! - [`WireError`] and [`Code`]: errors are replies.
//! - [`encode`] and [`decode`]: bytes; a foreign protocol version is told apart from malformed bytes.
//! - [`convert`]: between messages and the types of `twinstep-model`.

mod codec;
pub mod convert;
mod error;
pub mod keys;
pub mod message;
pub mod tensor;

pub use codec::{PROTOCOL, decode, encode};
pub use error::{ErrorCode, ErrorReply};
