//! Why a benchmark returned no number.

/// Why a benchmark returned no number.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The caller interrupted it.
    #[error("interrupted")]
    Interrupted,
    /// A part of the measurement failed.
    #[error(transparent)]
    Failed(Box<dyn std::error::Error + Send + Sync>),
}

/// Wraps any other error.
pub(crate) fn failed(error: impl std::error::Error + Send + Sync + 'static) -> BenchError {
    BenchError::Failed(Box::new(error))
}

/// Returns true once the user has asked to stop; called between windows.
pub type Interrupted<'a> = &'a dyn Fn() -> bool;

/// Returns an error if the user has asked to stop.
pub(crate) fn check(interrupted: Interrupted) -> Result<(), BenchError> {
    if interrupted() { Err(BenchError::Interrupted) } else { Ok(()) }
}
