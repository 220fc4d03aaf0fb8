//! Requirements on the data of a log, without which an effect is not identifiable from it.

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
