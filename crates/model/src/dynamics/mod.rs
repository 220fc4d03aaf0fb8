//! Kinematics and dynamics of many robots at once, one per SIMD lane, generic over [`twinstep_simd::SimdFloat`].
//!
//! - [`Vec3`], [`Inertia`], [`Cholesky`]: vectors, bodies and factored matrices.
//! - [`KinematicTree`]: inertial parameters and geometry of a robot; [`State`]: positions and velocities.
//! - [`Frames`]: poses of bodies, and points on them ([`LegFrames::calf_point`], [`LegFrames::calf_jacobian`]).
//! - [`inverse_dynamics`], [`mass_matrix`], [`forward_dynamics`]: the equations of motion (Featherstone 2008).
//! - [`FactoredDynamics`]: the equations of one time step, factored so that constraint rows are cheap. The batch engine
//!   uses it.
//! - [`SimdActuators`]: computes torques from commands, and friction and spring torques at the joints.
//!
//! Base quantities are in base axes at the base's origin. Joint order is [`crate::Joint::ALL`].

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "matrix indices as in the textbook")]

mod actuators;
mod equations;
mod factored;
mod spatial;
#[cfg(test)]
mod tests;
mod tree;

pub use actuators::{JointForces, SimdActuators, SimdCommands};
pub use equations::{Acceleration, Wrench, inverse_dynamics, mass_matrix, spatial_matrix};
pub use factored::{FactoredDynamics, FactoredLeg, JointLoad, forward_dynamics};
pub use spatial::{Cholesky, Inertia, Vec3};
pub use tree::{Frames, KinematicTree, LegFrames, State};
