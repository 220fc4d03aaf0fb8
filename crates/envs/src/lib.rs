//! Reinforcement-learning tasks on any [`twinstep_model::Backend`]: observation, reward, termination, reset.
//!
//! - [`Task`]: what a policy and a critic observe, the reward terms, and the end of an episode. [`tasks`] has one file
//!   per task; [`TaskConfig`] is the `[task]` table of a config file.
//! - [`ControlledRobot`]: the robot as tasks see it, of any tree: its joints, gains and pose, its feet and its size.
//! - [`TaskEnv`]: a task on all robots of a backend, as a [`twinstep_model::VecEnv`].
//! - [`Course`]: the levels of robots on ground of several kinds.
//! - [`Path`]: a reference that moves along arcs on the ground, for the task `track`.
//! - [`Randomisation`]: the `[randomise]` table; each episode has its own robot, is pushed, and observes with
//!   [`ObservationNoise`].
//! - [`observe`]: the observation of U2E, eq. 14, for simulator, log and robot.
//! - [`reward`]: one function per reward term. Its name is the config key and the log key.
//! - [`CounterEnv`]: a task without physics, whose observation verifies which steps were executed.
//! - [`check_vec_env`]: checks the contract of a vector environment, local or remote.

mod check;
mod config;
mod controlled_robot;
mod counter;
mod course;
mod episode;
mod feet;
mod observation;
mod observation_noise;
mod path;
mod randomise;
pub mod reward;
mod task;
mod task_env;
pub mod tasks;
pub mod trot;

pub use check::{CheckError, check_vec_env};
pub use config::{ConfigError, over_defaults};
pub use controlled_robot::ControlledRobot;
pub use counter::{Counter, CounterEnv};
pub use course::Course;
pub use episode::{Episode, EpisodeStart, StepOutcome};
pub use observation::{CRITIC_OBS_LEN, OBS_LEN, base_spec, observe, observe_privileged, privileged_fields};
pub use observation_noise::{NoisyEntry, ObservationNoise, add_noise};
pub use path::{GroundPose, Path, PathShape};
pub use randomise::Randomisation;
pub use task::{RobotView, Step, Task, Truth, observe_next, repeat_first_frame};
pub use task_env::{TaskEnv, TaskEnvConfig};
pub use tasks::{
    Attitude, AttitudeConfig, ExploreConfig, Gait, GaitConfig, GaitTask, Getup, GetupConfig, Jump, JumpConfig,
    PoseConfig, PoseState, PoseTask, TaskConfig, Track, TrackConfig, Walk, WalkConfig, roll_and_pitch,
};
