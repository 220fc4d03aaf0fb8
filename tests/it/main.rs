//! Tests that cross crates, in one binary.

#![allow(clippy::unwrap_used)]

mod layering;
mod physics;
mod remote;
mod security;
mod tidy;
