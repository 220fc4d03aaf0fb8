//! System identification: comparison of measured logs with simulations, and estimation of parameters.
//!
//! - [`record()`]: simulates a motion file on a robot in a backend and returns the log.
//! - [`apply_sensors()`]: adds sensor noise and resolution to a simulated log.
//! - [`Experiment`]: a log split into windows that are simulated from measured states, with residuals in units of
//!   noise.
//! - [`BaseEstimate`]: motion of a floating base without motion capture, from legs and IMU.
//! - [`MeasuredStance`]: the wrench on the base of a standing robot that its feet do not exert.
//! - [`EffectAtScope`]: an effect to estimate, as in `coulomb_friction@calf`.
//! - [`replay`]: measured and simulated positions joint by joint.
//! - [`evaluate()`]: the errors of a model on a log; [`position_errors`]: the same over time.
//! - [`InverseDynamicsResidual`]: torque of the model's actuators minus the inverse dynamics, row by row.
//! - [`FreeParameter`]: a parameter of a model file that is estimated, with bounds and prior.
//! - [`CmaEs`]: the search distribution; [`GlobalSearch`]: CMA-ES on a least-squares problem, which can be interrupted and resumed.
//! - `local_search`: CMA-ES within the uncertainty of an estimate, where contacts make the cost rough.
//! - [`NuisanceModel`]: nuisance parameters, eliminated by generalised least squares.
//! - [`identify()`]: predicted identifiability, CMA-ES, Levenberg–Marquardt, `local_search`, then intervals and
//!   correlations.
//!
//! Simulators implement [`twinstep_model::Rollout`]; this crate does not depend on an engine.

mod base_estimate;
mod base_wrench;
mod cmaes;
mod effect_list;
mod error;
mod estimates;
pub mod evaluate;
pub mod experiment;
mod foot_heights;
mod global_search;
pub mod identify;
mod inverse_dynamics;
pub mod least_squares;
mod local_search;
pub mod nuisance;
pub mod orientation;
pub mod parameter;
mod record;
pub mod refine;
pub mod replay;
mod residual_torque;
mod sensors;
pub mod torque;
pub mod window;

#[cfg(test)]
mod tests;

pub use base_estimate::BaseEstimate;
pub use base_wrench::MeasuredStance;
pub use cmaes::CmaEs;
pub use effect_list::{DEFAULT_EFFECTS, EffectAtScope, EffectAtScopeError, UnknownEffect, default_effects, named};
pub use error::ExperimentError;
pub use estimates::{CorrelatedPairs, EstimateStatus, ParameterEstimate};
pub use evaluate::{Evaluation, JointEvaluation, evaluate, position_errors};
pub use experiment::{Experiment, SimulatedPose};
pub use foot_heights::{FootHeights, OffsetChange};
pub use global_search::GlobalSearch;
pub use identify::{
    Identification, IdentifyError, IdentifyOptions, IdentifyProgress, Stage, identify, predicted_information,
};
pub use inverse_dynamics::{InverseDynamicsResidual, JointSeries, JointTrajectory};
pub use nuisance::NuisanceModel;
pub use parameter::{FreeParameter, candidate, free_parameters, initial_coordinate, with_values};
pub use record::{RecordError, record};
pub use residual_torque::{residual_at_output, residual_at_sensor};
pub use sensors::{Sensor, apply_sensors};
pub use window::WindowConfig;
