//! The rapier engine against physics.

use twinstep_sim::RapierBackend as Simulator;

#[path = "physics.rs"]
#[allow(clippy::duplicate_mod, reason = "the same tests for each engine")]
mod physics;
