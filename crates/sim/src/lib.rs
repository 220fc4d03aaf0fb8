//! Simulation of many Go2 robots behind the trait [`twinstep_model::Backend`], with three engines.
//!
//! - [`SimConfig`]: engine, rates, terrain, base, threads; the `[sim]` table of a config file.
//! - [`RapierBackend`]: one rapier3d world per robot, stepped on all cores. The results are bitwise equal for any
//!   number of threads.
//! - [`BatchBackend`]: one robot per SIMD lane. The results are bitwise equal for any lane, batch size and number of
//!   threads.
//! - [`MujocoBackend`]: MuJoCo in a Python process, for comparison with an engine that others wrote. [`MujocoPlant`]: its
//!   robots with every effect, by equations that are not the model's.
//!
//! In one actuator period the PD loop samples the state once, and `physics_hz / actuator_hz` physics steps follow.

mod batch;
mod config;
mod error;
mod ground_shapes;
mod mujoco;
mod rapier;
mod robot_world;
mod rollout;
mod thread_pool;

pub use batch::{BatchBackend, BatchSnapshot, Placement, SimdPrecision, TreeCommand, TreeReadings, TreeSimulation};
pub use config::{Engine, RoughTerrain, SimConfig, SimConfigError, StepTerrain, Terrain};
pub use error::BackendBuildError;
pub use mujoco::{MujocoBackend, MujocoPlant};
pub use rapier::{RapierBackend, RobotSnapshot};
pub use rollout::BatchRollout;
