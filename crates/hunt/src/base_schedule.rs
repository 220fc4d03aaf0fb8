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
    /// Floating, walking in place, forwards, backwards and in curves: half a minute.
    Walking,
}

/// Length of a log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogLength {
    /// A sixth of the standard length: 10 s in place of a minute.
    TenSeconds,
    /// The standard length of the motion.
    #[default]
    Standard,
    /// Five times the standard length.
    FiveMinutes,
}

impl LogLength {
    /// All lengths.
    pub const ALL: [Self; 3] = [Self::TenSeconds, Self::Standard, Self::FiveMinutes];

    /// Returns the factor on the duration of each phase.
    pub fn factor(self) -> f64 {
        match self {
            Self::TenSeconds => 1.0 / 6.0,
            Self::Standard => 1.0,
            Self::FiveMinutes => 5.0,
        }
    }

    /// Returns the name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::TenSeconds => "logs of 10 s",
            Self::Standard => "logs of a minute",
            Self::FiveMinutes => "logs of five minutes",
        }
    }
}
