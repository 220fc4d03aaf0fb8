//! Mounting of the base in a case of a blind test.

use serde::{Deserialize, Serialize};

/// Mounting of the base during a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BaseSchedule {
    /// Fixed base.
    Fixed,
    /// Floating base: the robot stands.
    Floating,
    /// First fixed, then floating.
    FixedThenFloating,
    /// First fixed, then standing, swaying, trotting and hopping: a minute in all.
    Whole,
}
