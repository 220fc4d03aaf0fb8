//! Kinematics and dynamics of robots of any tree, one robot per SIMD lane.
//!
//! - [`TreeStructure`]: which body is where in the tree, the same in all lanes. Its index lists replace the shape that a robot has:
//!   the joints between the base and a body are the only ones that move it.
//! - [`TreeParameters`]: masses, inertias and places, which differ by lane; [`TreeState`]: positions and velocities.
//! - [`TreeMotion`]: places, axes and velocities of all bodies in a state.
//! - [`inverse_dynamics`], [`mass_matrix`]: the equations of motion (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 5
//!   and 6), with all quantities in base axes at the base's origin.
//! - [`FactoredTree`]: the equations of one time step, factored along the tree (chapter 6.5), so that constraint rows are as long as
//!   the branch that they act on.
//!
//! The frames of the robot are made parallel at position 0, so that most joints turn about an axis of their frame ([`JointAxis`]).

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "matrix indices as in the textbook")]

mod equations;
mod factored;
mod motion;
mod parameters;
mod structure;
#[cfg(test)]
mod tests;

pub use equations::{TreeAcceleration, TreeForces, inverse_dynamics, mass_matrix};
pub use factored::{FactoredTree, TreeLoad};
pub use motion::TreeMotion;
pub use parameters::{TreeParameters, TreeState};
pub use structure::{JointAxis, TreeStructure};
