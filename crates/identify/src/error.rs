//! Reasons why a log cannot be used as an experiment.

use twinstep_logs::replay::ReplayError;

/// Reason why a log cannot be used as an experiment.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// The commands of the log cannot be simulated.
    #[error(transparent)]
    Motion(#[from] ReplayError),
    /// The motion of a floating base was not measured and cannot be estimated.
    #[error(
        "segment `{segment}` has base \"floating\", but the log has no `{missing}`; a window starts from the orientation \
         (quat) and from position and velocity of the base (pos, vel), or from an estimate of both, which needs quat, \
         gyro and all joints"
    )]
    MissingBaseState {
        /// Name of the segment.
        segment: String,
        /// The missing channel.
        missing: String,
    },
    /// No row of the log can be simulated.
    #[error(
        "none of the {rows} rows of the log can be simulated: a contiguous range of rows has at least two, and where base is \
         \"floating\" some motor has kp above 0 or a tau_ff; log rows in which the motors hold or move the robot"
    )]
    NothingToSimulate {
        /// Number of rows of the log.
        rows: usize,
    },
}
