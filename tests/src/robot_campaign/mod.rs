//! Fault campaign of the safety state machine with the fake Go2: is every fault followed by its reaction?
//!
//! - [`table`]: each fault in each state, compared with the table of the `robot` crate.
//! - [`sequence`]: random sequences of requests, actions and faults.
//! - [`invariants`]: what is true after every step, whatever happens.
//! - [`wire`]: the same sequences on the robot's own wire, in real time.
//! - [`report`]: the results as Markdown.

pub mod invariants;
pub mod report;
pub mod sequence;
pub mod table;
pub mod wire;
