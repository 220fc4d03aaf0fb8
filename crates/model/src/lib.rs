//! Types and robot model that all Twinstep crates share.
//!
//! - [`Joint`] and the joint order; [`RobotModel`] and [`go2`], the nominal robot with the source of each parameter.
//! - [`Command`], [`RobotStates`] and [`InitialState`]: commands, measured and simulated states, and reset states.
//! - [`Backend`]: a batch of robots that are commanded and observed together (simulator, replayed log, real robot).
//! - [`Actuator`]: computes torques from commands and states. Actuator networks implement it.
//! - [`VecEnv`]: a batch of environments that are reset and stepped together, in process or over a network;
//!   [`EnvSpec`]: layouts, periods, gains and limits of an environment; [`Trajectory`]: its steps in a row.
//! - [`Scene`]: shapes and poses for rendering; [`body_poses`]: forward kinematics;
//!   [`Feet`]: position and velocity of the feet.
//! - [`Ground`]: a plane, or a [`HeightField`] for uneven terrain.
//! - [`RobotTree`]: a robot of any shape; [`TreeModel`]: with its actuators and contact points, as the engines simulate it.
//! - [`mjcf()`]: the robot as a MuJoCo model.
//! - [`Rollout`]: simulates command sequences with many candidate robots at once.
//! - [`stream`]: reproducible random streams, one per consumer, from one seed.
//!
//! SI units, radians, seconds. The docs of each vector give its frame, world or base. The base frame is fixed to the
//! trunk: x forward, y left, z up. Quaternions in arrays are `[w, x, y, z]` and rotate from base to world.

mod agent_commands;
mod backend;
mod base_mount;
mod body;
mod command;
mod command_bounds;
mod feet;
pub mod frames;
mod go2;
mod ground;
mod height_field;
mod initial_state;
mod joint;
mod kinematics;
mod log_cholesky;
mod look;
mod mjcf;
mod real_time;
mod robot;
mod robot_sample;
mod robot_states;
mod rollout;
mod scene;
mod scene_shape;
mod spec;
mod stream;
mod trajectory;
mod tree;
mod tree_model;
mod vec_env;

pub use agent_commands::{AgentCommands, GaitCommand, VelocityCommand};
pub use backend::{
    Actuator, ActuatorMode, ActuatorSnapshot, ActuatorTap, Backend, BackendError, EpistemicUncertainty, Restorable,
    Simulator,
};
pub use base_mount::BaseMount;
pub use body::RigidBody;
pub use command::Command;
pub use feet::{Feet, Foot, FootMotion};
pub use go2::go2;
pub use ground::{Ground, Patches};
pub use height_field::{HeightField, HeightFieldError};
pub use initial_state::InitialState;
pub use joint::{JOINT_NAMES, Joint, JointKind, Leg, NUM_JOINTS, NUM_LEGS, PerJoint, PerLeg, UnknownJoint};
pub use kinematics::{FIXED_BASE_HEIGHT, NUM_BODIES, Pose, body_poses};
pub use mjcf::{CompliantStand, MjcfActuator, MjcfOptions, mjcf};
pub use real_time::{RealTimeReport, ResetCause, RobotStop};
pub use robot::{
    ActuatorParams, CONTACT, Contact, ControlConfig, Derating, JointModel, JointSpring, LegModel, Ripple, RobotModel,
    Shapes, Stribeck,
};
pub use robot_sample::RobotSample;
pub use robot_states::{GroundTruth, Measured, RobotStates, RobotStatesMut};
pub use rollout::{HistoryStep, Precision, Rollout, RolloutRequest};
pub use scene::Scene;
pub use scene_shape::{ConvexMesh, SceneShape, ShapeKind};
pub use spec::{EnvSpec, SpecDifference, SpecField};
pub use stream::{Stream, standard_normal, stream};
pub use trajectory::Trajectory;
pub use tree::{FreeJoint, RobotTree, TreeBody, TreeJoint, TreeJointKind, TreeShape, TreeShapeKind};
pub use tree_model::{AsymmetricForce, ContactPoint, TreeModel};
pub use vec_env::{AutoresetMode, EndedEpisode, EnvError, ResetRequest, StepBatch, VecEnv};
