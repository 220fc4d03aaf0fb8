//! Runs policies of any source on a robot, simulated or real, and records a log.
//!
//! - [`LoadedPolicy`]: a policy file, an ONNX file of `twinstep train`, or an ONNX file of another program with its
//!   [`Mapping`]. [`LoadedPolicy::bind`] compares it with the robot; a [`BoundPolicy`] computes actions.
//! - [`run`]: steps one robot with the actions of a policy, in real time. [`Recorder`] writes the log, [`JointRecorder`]
//!   one at the rate of the actuators.
//! - [`OnnxNetwork`]: an ONNX file with its inputs and outputs, the [`Port`]s.
//!
//! A *mapping* says how the observation and the action of a policy are made from those of Twinstep: order of the joints,
//! scales, default pose, history.

mod contract;
mod error;
mod history;
mod import;
mod joint_recorder;
mod mapped_policy;
mod mapping;
mod network_state;
mod onnx;
mod pacer;
mod policy;
mod policy_input;
mod recorder;
mod run;
mod summary;

pub use contract::{contract_of_mapping, read_contract};
pub use error::AgentError;
pub use import::{Alternative, ImportedPolicy, import_policy};
pub use joint_recorder::JointRecorder;
pub use mapping::{History, HistoryLayout, HistoryOrder, InputTable, Mapping, Numbers, StatePair, Term, TermName};
pub use onnx::{OnnxError, OnnxNetwork, Port};
pub use policy::{BoundPolicy, LoadedPolicy};
pub use policy_input::PolicyInput;
pub use recorder::Recorder;
pub use run::{Control, Recorders, RunPlan, Status, WantedCommands, run};
pub use summary::{RunSummary, Spread};
