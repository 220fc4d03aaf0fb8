//! Learned drives that know what they do not know: a deep ensemble of recurrent networks (U2E §II-B, III-A, III-B).
//!
//! A network sees what a joint's controller sees, ξ = [Δq, Δq̇] (command less measurement), row after row, and gives the
//! joint's torque as a Gaussian. Several of them, which differ in their first weights and in the order of what they learnt
//! from, agree where they have seen data and disagree where they have not. These types carry the crate:
//!
//! - [`DataSet`] is measured logs as runs of rows without a gap, in three roles by blocks of time: to learn from, to stop
//!   by, to judge by.
//! - [`Training`] trains the members of an ensemble, tells its progress, ends when asked to, and goes on from a
//!   [`Checkpoint`] as if it had never ended. It does so on the CPU, or with the feature `gpu` on a GPU.
//! - [`Ensemble`] is the trained members with all that their numbers depend on ([`Description`]): time step, scales, joints,
//!   sensor, gains. It predicts, and it is read from and written to a safetensors file.
//! - [`Calibration`] says how often the truth lies where an ensemble says it does.
//! - [`disagreement`] and [`jensen_renyi`] turn the members' Gaussians into epistemic uncertainty, the latter as the
//!   paper has it.
//! - [`LearnedRobot`] is a model file's robot with an ensemble in place of its drives, and what is left of it to simulate;
//!   [`LearnedDrives`], which it makes, drives many robots in either engine and tells what it does not know about them.
//! - [`Inference`] hears robots row by row without a simulator; [`BurnInference`] is the same in burn's operations, to be
//!   measured beside it.
//! - [`EnsembleError`] says what is wrong with a log or a file, and how to mend it.
//!
//! SI units: torques in \[N·m], errors in \[rad] and \[rad/s]. What a network computes is normalised; nothing normalised
//! leaves the crate. The step of time is part of a model: one of another step is refused.

mod activation;
mod adam;
mod by_hand;
mod calibration;
mod checkpoint;
mod data;
mod drives;
mod encoder;
mod ensemble;
mod error;
mod euf;
mod file;
mod gpu;
mod inference;
mod kernel;
mod learned_robot;
mod member;
mod network;
mod networks;
mod reference;
mod scales;
mod smooth;
mod train;
mod weights;
mod wide;
mod windows;

pub use calibration::{Calibration, Coverage};
pub use checkpoint::Checkpoint;
pub use data::{Split, DataSet, Sequence};
pub use drives::ActuatorNetwork;
pub use ensemble::{EnsembleMetadata, Ensemble, Gaussian, JointEncoding};
pub use error::EnsembleError;
pub use euf::{epistemic_uncertainty, jensen_renyi};
pub use inference::Inference;
pub use learned_robot::ActuatorNetworkRobot;
pub use reference::BurnInference;
pub use scales::{Normaliser, Normalisers};
pub use train::{Epoch, TrainingOptions, TrainingResult, TrainingEvent, Training};
