//! Comparison of the rapier engine with closed forms and conservation laws.

use twinstep_sim::{Engine, RapierBackend as TestedBackend};

const ENGINE: Engine = Engine::Rapier;

#[path = "physics.rs"]
#[allow(clippy::duplicate_mod, reason = "the same tests for each engine")]
mod physics;
