//! The real Go2: commands that are safe to send, and the state machine that decides which one is sent.
//!
//! [`SafetyMachine::step`] is called for every state that arrives, and at the latest every 2 ms. It has no clock, no
//! thread and no network: its input is all that happened since the last call, its output is the command to send now.
//!
//! [`control_loop`] runs it in real time on the robot's DDS topics ([`dds`]), and [`watch`] looks for others that command
//! the robot. [`RobotHandle`] is how other threads see the loop, [`RobotBackend`] the robot as the [`Backend`] of an
//! environment, [`Recorder`] writes all messages to a file.
//!
//! [`Backend`]: twinstep_model::Backend
//!
//! - [`Reading`]: the measurements in a [`LowState`](twinstep_unitree::LowState) whose checksum is right, in the order of
//!   the policy's joints.
//! - [`SafeCommand`]: a command that is finite and inside the limits. Only it becomes a
//!   [`LowCmd`](twinstep_unitree::LowCmd), by [`SafeCommand::to_low_cmd`].
//! - [`Fault`]: why the robot stopped, kept until the operator arms the robot again.
//! - [`SafetyConfig`]: limits and times, with the defaults that are used below.
//! - [`preflight`]: what is wrong with the robot, its sensors or the policy's contract, before a policy moves it.
//! - [`fake`]: a strict fake of the robot, for tests without one.
//!
//! # States
//!
//! | state | what is sent | it is left |
//! |---|---|---|
//! | `disconnected` | nothing | to `observe` after half a second with 400 states per second |
//! | `observe` | nothing | to `damp` when the operator arms; to `disconnected` on stale states |
//! | `damp` | gains kp = 0, kd = 3 N·m·s/rad | to `stand_up` when the operator says so and the robot is upright and at rest; to `observe` when the operator disarms, after 0.1 s |
//! | `stand_up` | positions from the measured pose to the crouched and the default pose, in 1 s and 2 s | to `ready` when every joint is within 0.15 rad of the default pose |
//! | `ready` | the default pose | to `run` with the first action for the present tick |
//! | `run` | `q_default + action_scale · action`, clipped; the last one while an action is missing | to `hold` at the third missed action; to `stand_up` when the client ends its episode |
//! | `hold` | the last positions, with gains that rise to those of standing in 0.5 s | to `run` with an action for the present tick; to `sit` at the tenth missed action; to `stand_up` when the client ends its episode |
//! | `sit` | positions to the crouched pose, in 2 s | to `damp`, or to `fault` if a fault was the cause |
//! | `fault` | gains kp = 0, kd = 3 N·m·s/rad | to `damp` when the operator arms again; to `observe` when the operator disarms, after 0.1 s |
//!
//! The operator can also say `sit` (from `stand_up`, `ready`, `run`, `hold`) and `damp` (from these and from `sit`). A
//! command is sent in every state but the first two. A request in the step in which damping follows on a fault is refused.
//!
//! # Faults
//!
//! | fault | limit | reaction |
//! |---|---|---|
//! | stale state | older than 20 ms, found twice in a row; a state whose clock stands still does not count | `fault` |
//! | another writer of `rt/lowcmd`; built-in controller active | | `fault` |
//! | L2 + B on the remote control; stop request | | `fault` |
//! | lost messages to the motors | more than 20 within 1 s | `fault` |
//! | tilt | 60° | `fault` |
//! | accelerometer and orientation disagree about the vertical, in means over 0.5 s | 40° | `fault` |
//! | joint limit | 1.1 of the joint's range | `fault` |
//! | torque | 0.9 of the joint's limit for 0.3 s | `fault` |
//! | motor temperature | 85 °C | `sit` |
//! | supply voltage | 24 V | `sit` |
//! | remote control lost | 1 s | `sit` |
//! | client lost, in `run` and `hold` | | `sit` |
//! | actions late | ten in a row | `sit` |
//! | standing pose not reached | 1 s after the end of the motion | `sit` |
//!
//! In `damp` only faults count that say that this process does not control the motors: the first five rows without tilt.
//! [`Fault::counts_in`] is the exact rule.
//!
//! # Actions
//!
//! Time is divided into policy periods, the ticks, which are counted from the clock's zero. An action belongs to the tick
//! of the observation that it responds to, and is executed when it arrives within this tick. Later it is refused: an
//! action that waited in a queue is never executed. A joint's commanded position changes by at most 0.5 rad from one
//! tick to the next and stays within 0.95 of the joint's range; [`Output::applied`] is the action that remains.

mod backend;
mod clock_check;
mod command;
mod command_datagram;
mod config;
pub mod control_loop;
pub mod dds;
pub mod fake;
pub mod fake_wire;
mod fault;
mod imu_check;
mod input;
mod interface;
mod machine;
mod monitor;
mod motor_link;
pub mod preflight;
pub mod preflight_loop;
mod reading;
pub mod real_time_thread;
mod recorder;
mod resampler;
mod robot_handle;
mod robot_writer;
mod state;
mod timing;
mod trajectory;
mod unsafe_command;
pub mod watch;
pub mod watchdog;

#[cfg(test)]
mod tests;

pub use backend::RobotBackend;
pub use command::{CommandLimits, SafeCommand};
pub use config::{ConfigError, SafetyConfig};
pub use fault::{Fault, Reaction};
pub use input::{Action, ActionRefused, Client, Input, OperatorRequest, Output, RequestRefused};
pub use interface::{InterfaceError, interface_address};
pub use machine::SafetyMachine;
pub use motor_link::MotorLink;
pub use reading::{Reading, ReadingError};
pub use recorder::Recorder;
pub use robot_handle::{Board, RobotHandle};
pub use state::State;
pub use timing::{Histogram, Timing};
pub use unsafe_command::UnsafeCommand;
