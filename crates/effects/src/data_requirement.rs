//! Requirements on the data of a log, without which an effect is not identifiable from it.

use std::fmt;

/// Requirement on the data of a log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DataRequirement {
    /// A joint with at least four reversals.
    Reversals,
    /// A joint whose motion reaches a frequency [Hz].
    Bandwidth(f64),
    /// A joint whose speed is in [`LOW_SPEED`] for a tenth of the time.
    LowSpeed,
    /// A joint that reaches a fraction of its speed limit.
    Speed(f64),
    /// A joint that reaches a fraction of its torque limit.
    Torque(f64),
    /// A joint that covers a range of position [rad].
    Range(f64),
    /// Measured torque.
    TorqueMeasured,
    /// Rate of the rows [Hz].
    Rate(f64),
    /// Several values of kd.
    KdVaries,
    /// Several values of kp.
    KpVaries,
    /// Range of motor temperature [K].
    Temperature(f64),
    /// Range of supply voltage [V].
    Voltage(f64),
    /// Floating base.
    Floating,
    /// Base rotation, up to a rate [rad/s].
    BaseRotation(f64),
    /// Base orientation.
    Orientation,
    /// Base position or velocity.
    BasePose,
    /// Forces or contacts of the feet.
    FootContact,
}

/// Range of speed in which friction at low speed is visible [rad/s].
pub const LOW_SPEED: [f64; 2] = [0.02, 0.3];

impl fmt::Display for DataRequirement {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [slow, fast] = LOW_SPEED;
        match self {
            Self::Reversals => write!(formatter, "a joint with at least four reversals"),
            Self::Bandwidth(hz) => write!(formatter, "motion at {hz} Hz or more"),
            Self::LowSpeed => write!(formatter, "slow motion, {slow} to {fast} rad/s"),
            Self::Speed(share) => write!(formatter, "a joint at {:.0} % of its speed limit", 100.0 * share),
            Self::Torque(share) => write!(formatter, "a joint at {:.0} % of its torque limit", 100.0 * share),
            Self::Range(radians) => write!(formatter, "positions that span {radians} rad"),
            Self::TorqueMeasured => write!(formatter, "measured torque"),
            Self::Rate(hz) => write!(formatter, "rows at {hz} Hz or more"),
            Self::KdVaries => write!(formatter, "several values of kd"),
            Self::KpVaries => write!(formatter, "several values of kp"),
            Self::Temperature(kelvin) => write!(formatter, "motor temperatures that change by {kelvin} K"),
            Self::Voltage(volts) => write!(formatter, "a supply voltage that changes by {volts} V"),
            Self::Floating => write!(formatter, "a floating base"),
            Self::BaseRotation(rate) => write!(formatter, "a base that rotates at {rate} rad/s"),
            Self::Orientation => write!(formatter, "the orientation of the base"),
            Self::BasePose => write!(formatter, "position or velocity of the base"),
            Self::FootContact => write!(formatter, "forces or contacts of the feet"),
        }
    }
}
