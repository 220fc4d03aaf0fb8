//! Why a verb failed.

/// Reason why a verb failed.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// The user's input is invalid.
    #[error("{0}")]
    Input(miette::Report),
    /// Any other error.
    #[error("{0}")]
    Other(miette::Report),
    /// The user has interrupted it.
    #[error("interrupted")]
    Interrupted,
}

/// Wraps an error in the user's input.
pub fn input(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Input(miette::Report::msg(error.to_string()))
}

/// Wraps any other error.
pub fn other(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Other(miette::Report::msg(error.to_string()))
}
