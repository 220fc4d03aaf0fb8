//! What a log says about a robot: evaluation and identification of robots of any tree with a fixed base, from logs with any channels,
//! and diagnosis by one likelihood ([`equations`]).
//!
//! - [`JointLog`]: a log on the joints of a robot: columns by the robot's joint names, unknown gains, a tilted base.
//! - [`Window`]: rows that are simulated from their first measured state; [`simulate`]: simulates candidates in windows.
//! - [`Candidate`]: a robot with its gains, as one simulation has it.
//! - [`Quantity`]: what can be estimated at a joint, with its prior; [`FreeParameter`]: a quantity at joints.
//! - [`evaluate`]: the errors of a model. [`identify`]: estimates with intervals and correlations.
//!
//! Priors scale with the robot: see [`JointScale`]. Quadrupeds with a floating base and known gains have more methods in
//! `twinstep-identify`.

pub mod equations;
mod error;
mod evaluate;
mod fit;
mod identify;
mod joint_log;
mod noise;
mod options;
mod parameter;
mod prior;
mod simulate;
mod window;

pub use error::InferenceError;
pub use evaluate::evaluate;
pub use identify::{Estimate, Identification, identify};
pub use joint_log::{JointLog, joint_indices};
pub use options::IdentifyOptions;
pub use parameter::{Candidate, FreeParameter, ParameterRequest};
pub use prior::{JointScale, Quantity};
pub use simulate::{Trace, simulate};
pub use window::{Window, WindowLength, windows};
