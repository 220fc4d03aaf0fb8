//! Reasons why a backend cannot be built.

use std::path::PathBuf;

use crate::SimConfigError;
use crate::tree_error::TreeError;

/// Reasons why a backend cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum BackendBuildError {
    /// A setting is not allowed.
    #[error(transparent)]
    Config(#[from] SimConfigError),
    /// The initial state of a robot of any tree is not allowed.
    #[error("initial state: {0}")]
    InitialState(#[from] TreeError),
    /// The operating system could not start the threads.
    #[error("cannot start {threads} simulation threads: {source}")]
    Threads {
        /// Requested number of threads.
        threads: usize,
        /// Error of the thread pool.
        source: rayon::ThreadPoolBuildError,
    },
    /// The engine cannot simulate an effect of the robot's model.
    #[error("engine `{engine}` cannot simulate the effect `{effect}` of the robot's model; use `batch` or `rapier`")]
    Effect {
        /// The engine.
        engine: &'static str,
        /// The effect, as named in the catalogue.
        effect: &'static str,
    },
    /// The process with MuJoCo could not be started.
    #[error(
        "cannot start `{} -m twinstep.mujoco`, the process of engine `mujoco`: {reason}\n  \
         install it with `pip install \"twinstep[mujoco]\"`, or select another Python with TWINSTEP_PYTHON=PATH",
        python.display()
    )]
    Mujoco {
        /// The Python interpreter.
        python: PathBuf,
        /// What failed.
        reason: String,
    },
}
