//! Many robots at once: numbers with one value a robot, and the algorithms of the Go2's tree on them.
//!
//! - [`Lane`]: one number for each of several robots. [`F32x4`] and `f64` run anywhere; on x86-64 there are registers of
//!   SSE2, AVX2 and AVX-512, chosen at run time by [`Instructions`].
//! - [`Vec3`], [`Inertia`], [`Cholesky`]: vectors, bodies and factored matrices of lanes.
//! - [`Tree`]: the numbers of a robot; [`State`]: what moves.
//! - [`Frames`]: where bodies and points of them are ([`Frames::calf_point`], [`Frames::calf_jacobian`]).
//! - [`inverse_dynamics`], [`mass_matrix`], [`forward_dynamics`]: the equations of motion.
//! - [`Factored`]: the equations of one time step, factored so that constraint rows are cheap. The engine's core.
//! - [`Drive`]: from command to torque, with friction and springs behind it.
//!
//! Base quantities are in base axes at the base's origin. Joint order is [`crate::Joint::ALL`].

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]
#![allow(clippy::needless_range_loop, reason = "indices of matrices read as in the textbook")]

mod drive;
mod dynamics;
mod factored;
mod instructions;
mod lane;
mod spatial;
#[cfg(test)]
mod tests;
mod tree;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use drive::{SimdCommands, SimdActuators, JointForces};
pub use dynamics::{Acceleration, Wrench, forward_dynamics, inverse_dynamics, mass_matrix};
pub use factored::{FactoredDynamics, FactoredLeg, JointLoad};
pub use instructions::InstructionSet;
pub use lane::{F32x4, SimdFloat};
pub use spatial::{Cholesky, Inertia, Vec3};
pub use tree::{Frames, LegFrames, State, KinematicTree};
#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2F32, Avx2F64, Avx512F32, Sse2F32};
