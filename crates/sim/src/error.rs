//! Reasons why a backend cannot be built.

use crate::SimConfigError;

/// Reasons why a backend cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum BackendBuildError {
    /// A setting is not allowed.
    #[error(transparent)]
    Config(#[from] SimConfigError),
    /// The operating system could not start the threads.
    #[error("cannot start {threads} simulation threads: {source}")]
    Threads {
        /// Requested number of threads.
        threads: usize,
        /// Error of the thread pool.
        source: rayon::ThreadPoolBuildError,
    },
}
