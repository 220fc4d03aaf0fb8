//! Experiments with a walking robot that tell most about unknown parameters (SPI-Active, stage two).
//!
//! A policy follows velocity commands, and the run is recorded as a log. Which parameters can be identified from the log
//! depends on the commands. This crate chooses them:
//!
//! - [`CommandSequence`]: velocity commands, one after the other, and their file.
//! - [`simulate()`]: a policy follows one sequence on each robot of an environment. A [`Trial`] has the log of the run and
//!   the [`Motion`] that [`Limits`] are about.
//! - [`Unknowns`]: the parameters that are sought. [`Unknowns::information`] is the Fisher information of a log, in units
//!   of noise and prior: every window of 1 s starts in the measured state, so that the copies of a robot do not drift apart.
//! - [`Criterion`]: the number that is maximised: trace, as in the paper, D-optimal or A-optimal.
//! - [`design()`]: random sequences first, then CMA-ES.
//!
//! Differences to SPI-Active's released code: residuals are divided by the noise of their channel and parameters by the
//! standard deviation of their prior, where the release adds metres, radians and quaternions, and steps every parameter by 0.1.

mod criterion;
mod design;
mod random;
mod sequence;
#[cfg(test)]
mod tests;
mod trial;
mod unknowns;

pub use criterion::{Criterion, UnknownCriterion};
pub use design::{Design, DesignError, DesignOptions, RunSequences, Score, design};
pub use random::random_within_limits;
pub use sequence::{CommandRanges, CommandSequence, Segment, SequenceError};
pub use trial::{Limits, Motion, Trial, TrialError, Violation, gait_env, simulate, walking_env};
pub use unknowns::{InformationError, Unknowns};
