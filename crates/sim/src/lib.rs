//! Simulation of many Go2 robots behind the trait [`twinstep_model::Backend`], with three engines.
//!
//! - [`SimConfig`]: engine, rates, terrain, base, threads; the `[sim]` table of a config file.
//! - [`RapierBackend`]: one rapier3d world per robot, stepped on all cores. The results are bitwise equal for any
//!   number of threads.
//! - [`BatchBackend`]: one robot per SIMD lane. The results are bitwise equal for any lane, batch size and number of
//!   threads.
//! - [`MujocoBackend`]: MuJoCo in a Python process, for comparison with an engine that others wrote. [`MujocoPlant`]: its
//!   robots with every effect, by equations that are not the model's.
//! - [`TreeSimulation`]: robots of any tree, in the batch engine or in rapier; not behind [`twinstep_model::Backend`] yet.
//!
//! In one actuator period the PD loop samples the state once, and `physics_hz / actuator_hz` physics steps follow.

mod actuator_input;
mod batch;
mod checks;
mod config;
mod config_error;
mod course;
mod error;
mod ground_shapes;
mod mujoco;
mod placement;
mod rapier;
mod rapier_trees;
mod robot_world;
mod rollout;
mod thread_pool;
mod tree_engine;
mod tree_error;
mod tree_simulation;

pub use batch::{BatchBackend, BatchSnapshot, SimdPrecision};
pub use config::{Engine, RoughTerrain, SimConfig, StepTerrain, Terrain};
pub use config_error::SimConfigError;
pub use course::{CourseTerrain, PatchKind};
pub use error::BackendBuildError;
pub use mujoco::{MujocoBackend, MujocoPlant, effect_outside_mujoco};
pub use placement::Placement;
pub use rapier::{RapierBackend, RobotSnapshot};
pub use rollout::BatchRollout;
pub use tree_engine::{TreeCommand, TreeReadings};
pub use tree_error::TreeError;
pub use tree_simulation::TreeSimulation;
