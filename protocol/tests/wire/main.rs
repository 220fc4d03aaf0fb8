//! What other implementations of the wire rely on: bytes, tolerance, and a document that tells the truth.

mod codec;
mod golden;
mod spec;
