//! Proximal policy optimisation on any [`twinstep_model::VecEnv`], in process or remote.
//!
//! - [`Trainer`]: collects transitions with the current policy ([`Group`]), and updates actor and critic with them. A
//!   [`Learner`] is what is learnt; [`Iteration`] reports one rollout and update.
//! - [`PpoConfig`]: the settings, the `[train]` table of a config file.
//! - [`gae`]: the advantages; `update`: the gradient of the loss; [`Mirror`]: left and right exchanged.
//! - [`Checkpoint`]: state of a training in a file; [`EventFile`]: scalars for TensorBoard.
//!
//! Equal seeds, settings and environments give equal bits on any number of threads.

mod adam;
mod checkpoint;
mod config;
pub mod gae;
mod rollout;
mod statistics;
mod symmetry;
mod tensorboard;
mod trainer;
mod update;

pub use adam::Adam;
pub use checkpoint::Checkpoint;
pub use config::{PpoConfig, PpoConfigError};
pub use rollout::Group;
pub use statistics::{Statistics, VelocityLayout};
pub use symmetry::{Mirror, NoMirror};
pub use tensorboard::EventFile;
pub use trainer::{Iteration, Learner, LearningError, Trainer};

#[cfg(test)]
mod tests;
