//! Kinematics and dynamics of many robots at once, one per SIMD lane, generic over [`twinstep_simd::SimdFloat`].
//!
//! - [`Vec3`], [`Inertia`], [`Cholesky`]: vectors, bodies and factored matrices.
//! - [`State`]: positions and velocities; [`JointValues`]: an array or a vector with a number for each joint.
//! - [`StepEquations`]: the equations of one time step, factored so that constraint rows are cheap. The batch engine is written for any
//!   implementation. There are two: [`tree::TreeEquations`] for robots of any tree, and [`quadruped::FactoredDynamics`], which
//!   knows the shape of the Go2 and takes about half the time.
//! - [`tree`], [`quadruped`]: kinematics, inverse dynamics and mass matrix (Featherstone, "Rigid Body Dynamics Algorithms", 2008).
//! - [`SimdActuators`]: computes torques from commands, and friction and spring torques at the joints.
//!
//! Base quantities are in base axes at the base's origin.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "matrix indices as in the textbook")]

mod actuators;
pub mod quadruped;
mod spatial;
mod state;
mod step_equations;
pub mod tree;

pub use actuators::{JointForces, SimdActuators, SimdCommands, link_armature};
pub use spatial::{Cholesky, Inertia, Vec3, spatial_matrix};
pub use state::{JointValues, State};
pub use step_equations::StepEquations;
