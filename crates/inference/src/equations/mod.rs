//! Diagnosis by one likelihood: which effects of the catalogue a robot has that its model lacks.
//!
//! - [`explain`]: what explains a log; [`explanation`]: in the terms of the catalogue. The model for predictions has all that was fitted; causes
//!   are what of it the log shows with certainty.
//! - [`measurements`]: the channels of a log, with less noise by a [`smoother`]; [`robot`]: what effects change.
//! - [`residuals`]: residuals of a log, and the column of any change of the robot; [`site`]: where changes act.
//! - [`torque_residuals`]: residuals of a log with torques, without simulation, from [`system`]. [`drive`]: the torque of each drive;
//!   [`balance`]: the balance of each joint and of the base in [`samples`] of the log, with its [`columns`], on the [`feet`] that stand; each [`touch`] of a foot on the [`ground`]; the gyroscope.
//! - [`positions`]: residuals of a log without torques on a fixed base, by simulation; [`small_changes`]: what every robot has a little of.
//! - [`gaussian`]: the evidence of residuals that are linear in unknowns with normal priors; [`block`]: the noise that is left;
//!   [`normal`]: unknowns that have a least value; [`triangular`]: inverses.
//! - [`law`]: an effect with its unknowns. [`nuisance`]: what every robot has a little of.
//! - [`search`]: the set of causes of highest evidence, by [`screening`] of all effects, a [`fit`] of the best, and its [`refinement`]; [`imitations`]: causes that only imitate
//!   another law; [`outcome`]: what it found. [`another_law`]: sums of [`unknown`] functions, that explain more than a cause, or what all causes leave.

mod another_law;
mod balance;
mod block;
mod causes;
mod columns;
mod drive;
mod explain;
mod explanation;
mod feet;
mod fit;
mod gaussian;
mod ground;
mod imitations;
mod law;
mod measurements;
mod normal;
mod nuisance;
mod outcome;
#[cfg(test)]
mod position_tests;
mod positions;
mod problem;
mod refinement;
mod residuals;
mod robot;
#[cfg(test)]
mod sample_tests;
mod samples;
mod screening;
mod search;
mod site;
mod small_changes;
mod smoother;
mod system;
#[cfg(test)]
mod tests;
mod torque_residuals;
mod touch;
mod triangular;
mod undetermined;
mod unknown;

pub use causes::{LawTerm, UnknownLaw};
pub use explain::{explain, explain_tree, torque_error};
pub use explanation::{Explained, Explanation, OfJoint, Passed};
