//! Reinforcement-learning tasks on any [`twinstep_model::Backend`]: observation, reward, termination, reset.
//!
//! - [`TaskEnv`]: the task `walk`, a [`twinstep_model::VecEnv`] on any backend. [`TaskConfig`] and [`Randomisation`]
//!   are the `[task]` and `[randomise]` tables of a config file.
//! - [`observe`] and [`walk_spec`]: the observation of U2E, eq. 14, for simulator, log and robot.
//! - [`reward`]: one function per reward term. Its name is the config key and the log key.
//! - [`CounterEnv`]: a task without physics, whose observation verifies which steps were executed.
//! - [`check_vec_env`]: checks the contract of a vector environment, local or remote.

mod check;
mod config;
mod counter;
mod episode;
mod observation;
pub mod reward;
mod task_env;
pub mod trot;

pub use check::{CheckError, check_vec_env};
pub use config::{CommandRanges, ConfigError, Randomisation, RewardWeights, TaskConfig, TaskName};
pub use counter::{Counter, CounterEnv};
pub use observation::{OBS_LEN, observe, walk_spec};
pub use task_env::{TaskEnv, TaskEnvConfig};
