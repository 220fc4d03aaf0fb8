//! Measured logs against simulations: what a model gets wrong, and which numbers would mend it.
//!
//! - [`motion`]: the commands of a log, row by row, in periods of the drive.
//! - [`record()`]: a motion through a robot in a backend, as a log.
//! - [`measured()`]: an exact log as sensors show it.
//! - [`Experiment`]: a log cut into windows that are simulated from measured states, and what is compared, each channel
//!   in units of its noise.
//! - [`evaluate()`]: the errors of a model on a log; [`position_errors`]: the same over time.
//! - [`Balance`]: what a model's drives give in a measured motion, less what its bodies need, row by row.
//! - [`SafeMotion`]: what the next experiment is chosen from; [`Rivalry`]: how far one would part two causes.
//! - [`Diagnosis`]: what a diagnosis says, as in `findings.json`.
//! - [`Unknown`]: a number of a model file that is sought, with bounds and prior.
//! - [`Search`]: the global search, which can be ended and taken up again.
//! - [`identify()`]: CMA-ES, then Gauss-Newton, then intervals, and what the log cannot tell.
//!
//! Simulators come in as a [`twinstep_model::Rollout`]: this crate knows none.

mod balance;
mod cmaes;
mod conditions;
mod diagnose;
mod diagnosis;
mod evaluate;
mod experiment;
mod identify;
pub mod motion;
mod record;
mod refine;
mod safe_motions;
mod search;
mod sensors;
mod task;
mod tolerance;
mod torque;
mod unknown;
mod window;

pub use balance::{InverseDynamicsResidual, JointTrajectory, JointSeries};
pub use diagnose::{DiagnoseError, DiagnosisOutput, ProposedExperiment, HypothesisPair, diagnose, diagnose_torques};
pub use diagnosis::{
    Cause, CorrelatedPair, Diagnosis, RmsErrors, Estimate, NextExperiment, DiscriminatedPair, AlternativeCause, Unexplained, ParameterValue,
};
pub use evaluate::{Evaluation, JointEvaluation, evaluate, position_errors};
pub use experiment::{Experiment, ExperimentError};
pub use identify::{ParameterEstimate, Identification, IdentifyError, IdentifyOptions, IdentifyProgress, Stage, EstimateStatus, identify};
pub use record::{RecordError, record};
pub use safe_motions::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
pub use search::GlobalSearch;
pub use sensors::{Sensor, apply_sensors};
pub use unknown::{FreeParameter, candidate, initial_coordinate, free_parameters, with_values};
pub use window::WindowConfig;
