//! Actuator networks with epistemic uncertainty: a deep ensemble of LSTMs (U2E §II-B, III-A, III-B).
//!
//! The input of a network is ξ = [Δq, Δq̇] of one joint (command minus measurement), row after row, or the torque that
//! was asked for and the joint velocity ([`NetworkInput`]). The output is the joint torque as a Gaussian, or the part of
//! it that a model of the robot lacks ([`NetworkTarget`]). The members differ in their initial weights and in the order of the training data.
//! Their predictions agree where there are training data and differ elsewhere. The main types:
//!
//! - [`DataSet`]: measured logs as sequences of contiguous rows. Blocks of time are split into training, validation
//!   and test data.
//! - [`Training`]: trains the members of an ensemble on the CPU, or with the feature `gpu` on a GPU. It reports
//!   progress, can be interrupted, and resumes from a [`Checkpoint`] with the same result.
//! - [`Ensemble`]: the trained members with their [`EnsembleMetadata`] (time step, normalisers, joints, sensor, gains).
//!   It predicts torques and is stored in a safetensors file.
//! - [`Calibration`]: empirical coverage of the prediction intervals on the test split.
//! - [`epistemic_uncertainty`] and [`jensen_renyi`]: epistemic uncertainty from the members' Gaussians, the latter as
//!   in U2E.
//! - [`ActuatorNetworkRobot`]: the robot of a model file whose actuators an ensemble replaces or completes. It creates the
//!   [`ActuatorNetwork`], which computes the torques of many robots in either engine, and their epistemic uncertainty.
//! - [`Inference`]: evaluates an ensemble row by row without a simulator. [`BurnInference`] is the baseline in burn's
//!   operations.
//! - [`EnsembleError`]: describes what is wrong with a log or a file, and how to fix it.
//!
//! Public quantities are in SI units: torques in \[N·m], errors in \[rad] and \[rad/s]. The networks compute with
//! normalised quantities. The time step is part of a model: it is evaluated at its own rate, and its torque is held in
//! between.

mod activation;
mod actuator_network;
mod actuator_network_robot;
mod adam;
mod burn_inference;
mod calibration;
mod checkpoint;
mod data;
mod encoder;
mod ensemble;
mod epistemic_uncertainty;
mod error;
mod file;
mod gpu;
mod inference;
mod kernel;
mod member;
mod member_batch;
mod metadata;
mod network;
mod network_input;
mod normaliser;
mod sequences;
mod smooth;
mod synthetic;
mod train;
mod training_options;
mod warm_start;
mod weights;

pub use actuator_network::ActuatorNetwork;
pub use actuator_network_robot::{ActuatorNetworkRobot, check_effects};
pub use burn_inference::BurnInference;
pub use calibration::{Calibration, Coverage};
pub use checkpoint::{Checkpoint, Epoch};
pub use data::{DataOptions, DataSet, Sequence, Split};
pub use ensemble::{Ensemble, Gaussian};
pub use epistemic_uncertainty::{epistemic_uncertainty, jensen_renyi};
pub use error::EnsembleError;
pub use inference::Inference;
pub use metadata::{EnsembleMetadata, JointEncoding};
pub use network_input::{NetworkInput, NetworkTarget};
pub use normaliser::{Normaliser, Normalisers};
pub use train::{Training, TrainingEvent, TrainingResult};
pub use training_options::TrainingOptions;
