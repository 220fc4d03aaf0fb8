//! What one does with Twinstep, as functions with an options struct and a result struct.
//!
//! | verb | from | to |
//! |---|---|---|
//! | [`train`] | task and robot | a policy |
//! | [`evaluate_policy`] | a policy | its errors and falls, by condition |
//! | [`record`] | a policy and a robot at an endpoint | a log |
//! | [`evaluate`] | a model and a log | the model's errors |
//! | [`fit`] | logs | an ensemble of actuator networks |
//! | [`identify`] | logs and a list of effects | their parameters |
//! | [`diagnose`] | logs | causes, and a corrected model |
//! | [`design`] | a policy and unknown effects | commands that tell most about them |
//! | [`adapt`] | a policy and logs of a robot | a policy for this robot, and its gain |
//! | [`u2e`], [`spi_active`] | a robot at an endpoint | the loops of the two papers, in stages that can be resumed |
//!
//! Every verb reports to an [`Observer`], which can interrupt it: [`Observer::silent`] for use as a library,
//! [`Observer::terminal`] for a program. Every verb fails with a [`Failure`].

pub mod adapt;
pub mod ambiguous_effects;
mod checks;
mod command_env;
pub mod comparison;
mod cross_evaluation;
mod date;
pub mod design;
pub mod design_report;
pub mod diagnose;
mod diagnosis_text;
pub mod evaluate;
pub mod evaluate_policy;
pub mod failure;
pub mod fit;
mod fit_report;
pub mod identify;
pub mod identify_options;
mod identify_report;
mod identify_tree;
mod learned_residual;
pub mod log_motion;
pub mod measure_tables;
pub mod observer;
pub mod open_log;
pub mod player;
pub mod progress_lines;
mod random_commands;
pub mod record;
pub mod rehearsal;
pub mod robot_file;
pub mod rows;
pub mod signals;
pub mod spi_active;
mod spi_active_config;
mod spi_active_report;
mod stages;
mod status_line;
mod task_error;
pub mod train;
pub mod train_config;
mod train_endpoints;
mod train_evaluation;
mod train_log;
pub mod train_options;
mod train_session;
pub mod tree_model;
pub mod u2e;
mod u2e_config;
mod u2e_evaluation;
mod u2e_report;
pub mod web_page;

pub use adapt::{AdaptOptions, Adapted, adapt};
pub use comparison::Comparison;
pub use design::{DesignOptions, Designed, design};
pub use diagnose::{DiagnoseOptions, Diagnosed, diagnose};
pub use evaluate::{EvaluateOptions, evaluate};
pub use evaluate_policy::{Course, EvaluatePolicyOptions, PolicyEvaluation, evaluate_policy};
pub use failure::Failure;
pub use fit::{FitOptions, Fitted, fit, fit_stages};
pub use identify::identify;
pub use identify_options::{Identified, IdentifyOptions};
pub use observer::Observer;
pub use record::{RecordOptions, Recording, Velocity, record};
pub use rows::RowSelection;
pub use spi_active::spi_active;
pub use train::{Trained, train};
pub use train_config::TrainConfig;
pub use train_options::{Start, TrainOptions};
pub use u2e::u2e;
