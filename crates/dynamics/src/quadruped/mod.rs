//! Kinematics and dynamics of a trunk with four legs of three joints, as the Go2: the first joint of a leg turns about x, the others about y.
//!
//! - [`KinematicTree`]: inertial parameters and geometry; [`Frames`]: poses of bodies, and points on them.
//! - [`inverse_dynamics`], [`mass_matrix`], [`forward_dynamics`]: the equations of motion.
//! - [`FactoredDynamics`]: the equations of one time step.
//!
//! Joint order is [`twinstep_model::Joint::ALL`]. Body 0 is the trunk, body `i + 1` that which joint `i` moves.

mod equations;
mod factored;
mod kinematics;
#[cfg(test)]
mod tests;

pub use equations::{Acceleration, Wrench, inverse_dynamics, mass_matrix};
pub use factored::{FactoredDynamics, FactoredLeg, forward_dynamics};
pub use kinematics::{Frames, KinematicTree, LegFrames};

/// Positions and velocities of a batch of quadrupeds, one per lane.
pub type QuadrupedState<T> = crate::State<T, [T; 12]>;
