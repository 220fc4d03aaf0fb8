//! Errors and checks of the arguments of a [`TreeSimulation`](crate::TreeSimulation).

/// Reasons why robots of a tree are not reset or stepped. None of them has changed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TreeError {
    /// An argument has the wrong number of entries.
    #[error("`{field}` has {given} entries; {expected} are expected, one per {per}")]
    WrongLength {
        /// The argument.
        field: &'static str,
        /// Number of entries of the argument.
        given: usize,
        /// Expected number of entries.
        expected: usize,
        /// What each entry belongs to: robot or joint.
        per: &'static str,
    },
    /// A number is NaN or infinite.
    #[error("`{field}` of entry {entry} is {value}; finite numbers are expected")]
    NotFinite {
        /// The argument.
        field: &'static str,
        /// Index of the entry.
        entry: usize,
        /// The number.
        value: f64,
    },
    /// A robot index is too large.
    #[error("robot {robot} does not exist; the number of robots is {num_robots}")]
    RobotOutOfRange {
        /// Requested index.
        robot: usize,
        /// Number of robots.
        num_robots: usize,
    },
    /// MuJoCo does not simulate an effect.
    #[error("the engine `mujoco` does not simulate the effect `{effect}` of robot `{name}`; `batch` does")]
    UnsupportedEffect {
        /// Name of the robot.
        name: String,
        /// The effect.
        effect: &'static str,
    },
    /// The process of MuJoCo has failed.
    #[error("the process of the engine `mujoco` has failed: {reason}")]
    Process {
        /// What it says.
        reason: String,
    },
    /// A fixed base cannot be pushed.
    #[error("the base of robot `{name}` is fixed; only a floating one can be pushed")]
    FixedBase {
        /// Name of the robot.
        name: String,
    },
    /// A robot has other bodies, joint axes or shapes than the first one.
    #[error("robot `{name}` has another tree than the simulated ones: {what}")]
    OtherTree {
        /// Name of the robot.
        name: String,
        /// What differs.
        what: &'static str,
    },
}

/// Checks that an argument has one finite number per joint.
pub fn check_joints(
    field: &'static str,
    values: impl ExactSizeIterator<Item = f64>,
    num_joints: usize,
) -> Result<(), TreeError> {
    if values.len() != num_joints {
        return Err(TreeError::WrongLength { field, given: values.len(), expected: num_joints, per: "joint" });
    }
    check_finite(field, values)
}

/// Checks that all numbers are finite.
pub fn check_finite(field: &'static str, values: impl Iterator<Item = f64>) -> Result<(), TreeError> {
    match values.enumerate().find(|(_, value)| !value.is_finite()) {
        Some((entry, value)) => Err(TreeError::NotFinite { field, entry, value }),
        None => Ok(()),
    }
}
