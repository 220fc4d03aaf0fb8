//! Reasons why a log or a request cannot be used.

use twinstep_logs::replay::ReplayError;
use twinstep_sim::{BackendBuildError, TreeError};

/// Reason why a log cannot be compared with a robot, or a parameter cannot be estimated.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    /// The robot has no joint of this name.
    #[error(
        "the robot has no joint `{joint}` of the log\n  its joints are {joints}\n  another robot: `--model FILE` (default: the Go2); \
         other names: `[joints.rename]` of the model file, such as `{example} = \"{joint}\"`"
    )]
    UnknownJoint {
        /// Name in the log.
        joint: String,
        /// Names of the robot's joints.
        joints: String,
        /// A joint of the robot that the log does not have.
        example: String,
    },
    /// Two joints of the log are one of the robot.
    #[error("the joints `{one}` and `{other}` of the log are the same joint of the robot")]
    SameJoint {
        /// A joint of the log.
        one: String,
        /// Another joint of the log.
        other: String,
    },
    /// The log lacks a required column.
    #[error(
        "joint `{joint}` of the log has no `{quantity}`: add a column `{quantity}_{joint}`, or leave the joint out of `joints` in the meta file"
    )]
    Missing {
        /// Name of the joint.
        joint: String,
        /// The missing quantity.
        quantity: &'static str,
    },
    /// No selected rows can be simulated.
    #[error(
        "there is nothing to simulate: the selected rows have no two consecutive rows in a segment with base \"fixed\"; a \
         floating base needs a quadruped like the Go2, and gains in the log"
    )]
    NothingToSimulate,
    /// The name is not one of a quantity that can be estimated.
    #[error(
        "`{given}` cannot be estimated; possible: {possible}, each with @all, @each or @JOINT, as in coulomb_friction@each"
    )]
    UnknownQuantity {
        /// The request.
        given: String,
        /// The names.
        possible: String,
    },
    /// The scope of a request is none of the robot's joints.
    #[error("`{given}`: `{scope}` is not a joint of the robot; possible: all (one value), each, {joints}")]
    UnknownScope {
        /// The request.
        given: String,
        /// The scope.
        scope: String,
        /// Names of the robot's joints.
        joints: String,
    },
    /// A parameter is requested twice.
    #[error("`{name}` is requested twice")]
    Twice {
        /// Name of the parameter.
        name: String,
    },
    /// `stop` was set.
    #[error("interrupted before completion")]
    Interrupted,
    /// The simulation of the given model diverges.
    #[error("the simulation of the given model diverges on this log: start from a model that does not diverge")]
    Diverges,
    /// The robot cannot be simulated.
    #[error(transparent)]
    Simulation(#[from] BackendBuildError),
    /// A robot cannot be reset or stepped.
    #[error(transparent)]
    Tree(#[from] TreeError),
    /// The log cannot be replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The effects of the model cannot be combined.
    #[error("the model: {0}")]
    Model(String),
}
