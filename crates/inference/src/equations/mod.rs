//! Diagnosis by one likelihood, from logs with motor torques: which effects of the catalogue a robot has that its model lacks.
//!
//! - [`explain`]: what explains a log, in the terms of the catalogue.
//! - [`measurements`]: the channels of a log; [`robot`]: what effects change.
//! - [`system`]: blocks of residuals without simulation, and the column of any change of the robot. [`drive`]: the torque of each drive;
//!   [`balance`]: the balance of each joint and of the base; the gyroscope.
//! - [`gaussian`]: the evidence of residuals that are linear in unknowns with normal priors; [`block`]: the noise that is left.
//! - [`law`]: an effect with its unknowns. [`nuisance`]: what every robot has a little of.
//! - [`search`]: the set of causes of highest evidence. [`unknown`]: functions that explain what the causes leave.

mod balance;
mod block;
mod drive;
mod explain;
mod gaussian;
mod law;
mod measurements;
mod nuisance;
mod robot;
mod search;
mod system;
mod unknown;

pub use explain::{Explained, Explanation, explain};
pub use search::UnknownLaw;
