//! What the tests of real links and real processes need.

pub mod process;
pub mod security;
