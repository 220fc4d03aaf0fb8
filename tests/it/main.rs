//! Tests that cross crates, in one binary.

#![allow(clippy::unwrap_used)]

mod faults;
mod layering;
mod physics;
mod remote;
mod tidy;
