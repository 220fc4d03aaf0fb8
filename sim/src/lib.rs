//! The Go2 as a simulated [`twinstep_model::Backend`] for many robots.
//!
//! - [`SimConfig`]: engine, rates, terrain, base, threads; the `[sim]` table of a config file.
//! - [`RapierBackend`]: one rapier3d world a robot, stepped on all cores; equal inputs give equal bits on any number
//!   of threads.
//! - [`BatchBackend`]: many robots in SIMD lanes; the same bits in any lane, batch size and number of threads.
//!
//! A drive period is one sample of the state, one torque for each joint, and `physics_hz / drive_hz` physics steps
//! under that torque.

mod batch;
mod config;
mod ground_shapes;
mod rapier;
mod robot_world;
mod rollout;

pub use batch::{BatchBackend, BatchSnapshot, SimdPrecision};
pub use config::{BaseMount, Engine, RoughTerrain, SimConfig, SimConfigError, Terrain};
pub use rapier::{BackendBuildError, RapierBackend, RobotSnapshot};
pub use rollout::BatchRollout;
