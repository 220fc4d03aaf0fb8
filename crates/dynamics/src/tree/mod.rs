//! Kinematics and dynamics of robots of any tree.
//!
//! - [`TreeStructure`]: which body is where in the tree, the same in all lanes. Its index lists replace the shape that a robot has:
//!   the joints between the base and a body are the only ones that move it.
//! - [`TreeParameters`]: masses, inertias and places, which differ by lane.
//! - [`TreeMotion`]: places, axes and velocities of all bodies in a state.
//! - [`inverse_dynamics`], [`mass_matrix`]: the equations of motion (Featherstone 2008, chapters 5 and 6), with all quantities in base
//!   axes at the base's origin.
//! - [`FactoredTree`]: the equations of one time step, factored along the tree (chapter 6.5), so that constraint rows are as long as
//!   the branch that they act on; [`TreeEquations`]: with the motion, as the batch engine uses them.
//!
//! The frames of the robot are made parallel at position 0, so that most joints turn about an axis of their frame ([`JointAxis`]).

mod equations;
mod factored;
mod motion;
mod parameters;
mod step;
mod structure;
#[cfg(test)]
mod tests;

pub use equations::{TreeAcceleration, TreeForces, inverse_dynamics, mass_matrix};
pub use factored::FactoredTree;
pub use motion::TreeMotion;
pub use parameters::{TreeParameters, batch_from_bodies};
pub use step::TreeEquations;
pub use structure::{JointAxis, TreeStructure};

/// Positions and velocities of a batch of robots, one per lane.
pub type TreeState<T> = crate::State<T, Vec<T>>;
