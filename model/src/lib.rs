//! The core that every Twinstep crate shares.
//!
//! A handful of types carries everything:
//!
//! - [`Joint`] and its one order; [`RobotModel`] and [`go2`], the nominal robot with the source of each number.
//! - [`Command`], [`RobotStates`] and [`Placement`]: what a robot is told, found doing, and how it is put down.
//! - [`Backend`]: many robots that are commanded and observed together (simulator, replayed log, real robot).
//! - [`Actuator`]: the drives between command and torque. Effects of reality and learned drives enter here.
//! - [`VecEnv`]: many environments that are reset and stepped together, in process or over a network, and
//!   [`EnvSpec`], what a client must know of them.
//! - [`Scene`]: what it takes to draw a robot; [`body_poses`], where its bodies are.
//! - [`Ground`]: what robots stand on: a plane, or a [`HeightField`] in it.
//! - [`mjcf()`]: the robot as a MuJoCo model.
//! - [`lanes`]: many robots in SIMD lanes, and the equations of motion of the Go2's tree in them.
//! - [`effects`]: what real robots do and ideal ones do not; [`ModelFile`] is a robot with some of them.
//! - [`Rollout`]: commands through many candidate robots at once.
//! - [`stream`]: one seed gives every consumer its own reproducible random numbers.
//!
//! SI units, radians, seconds. Vectors live in the world or the base frame, as their docs say; the base frame is the
//! trunk's: x forward, y left, z up. Quaternions in arrays are `[w, x, y, z]` and turn base into world.

mod backend;
mod body;
pub mod effects;
pub mod frames;
mod go2;
mod ground;
mod height_field;
mod joint;
mod kinematics;
pub mod lanes;
mod log_cholesky;
mod mjcf;
mod model_file;
mod robot;
mod rollout;
mod scene;
mod spec;
mod state;
mod stream;
mod vec_env;

pub use backend::{Actuator, ActuatorSnapshot, Backend, BackendError, EpistemicUncertainty};
pub use body::RigidBody;
pub use go2::go2;
pub use ground::Ground;
pub use height_field::{HeightField, HeightFieldError};
pub use joint::{JOINT_NAMES, Joint, JointKind, Leg, NUM_JOINTS, NUM_LEGS, PerJoint, PerLeg, UnknownJoint};
pub use kinematics::{FIXED_BASE_HEIGHT, NUM_BODIES, Pose, body_poses};
pub use mjcf::{BaseMount, MjcfActuator, MjcfOptions, mjcf};
pub use model_file::{EffectEntryError, ActuatorNetworkConfig, MemberSampling, ModelFile, ModelFileError};
pub use robot::{
    Contact, ControlConfig, Derating, ActuatorParams, JointModel, JointSpring, LegModel, Ripple, RobotModel, Shapes, Stribeck,
};
pub use rollout::{RolloutRequest, HistoryStep, Precision, Rollout};
pub use scene::{Scene, SceneShape, ShapeKind};
pub use spec::{EnvSpec, SpecField};
pub use state::{Command, InitialState, RobotStates, RobotStatesMut, RandomisationSample};
pub use stream::{Stream, standard_normal, stream};
pub use vec_env::{AutoresetMode, EndedEpisode, EnvError, ResetRequest, StepBatch, VecEnv};
