//! The rapier engine against physics.

use twinstep_sim::RapierBackend as Simulator;

#[path = "physics.rs"]
mod physics;
