//! Reasons why a log cannot be used as an experiment.

use twinstep_logs::replay::ReplayError;

/// Reason why a log cannot be used as an experiment.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// The commands of the log cannot be simulated.
    #[error(transparent)]
    Motion(#[from] ReplayError),
    /// The motion of a floating base was not measured.
    #[error(
        "segment `{segment}` has base \"floating\", but the log has no `{missing}`, which is needed for the initial \
         state of a window"
    )]
    MissingBaseState {
        /// Name of the segment.
        segment: String,
        /// The missing channel.
        missing: &'static str,
    },
}
