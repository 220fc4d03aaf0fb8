//! Tests that cross crates, in one binary.

#![allow(clippy::unwrap_used)]

mod exactly_once;
mod layering;
mod leases;
mod physics;
mod raw_client;
mod remote;
mod tidy;
mod wire;
