//! Tests that cross crates, in one binary.

#![allow(clippy::unwrap_used)]

mod physics;
mod remote;
