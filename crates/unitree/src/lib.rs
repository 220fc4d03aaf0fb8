//! Messages of the Unitree Go2, as they are on its DDS topics and in recordings of them.
//!
//! | topic | message |
//! |---|---|
//! | `rt/lowcmd` | [`LowCmd`] |
//! | `rt/lowstate` | [`LowState`] |
//! | `rt/sportmodestate` | [`SportModeState`] |
//! | `rt/wirelesscontroller` | [`WirelessController`] |
//! | `rt/api/<service>/request`, `…/response` | [`RpcRequest`], [`RpcResponse`] |
//!
//! [`decode`] and [`encode`] convert a message from and to CDR, the encoding of DDS. The checksum of [`LowCmd`] and
//! [`LowState`] is computed over another layout, that of the C structures ([`crc`]). Motors and feet are in the robot's
//! order, FR, FL, RR, RL; [`motor_index`] and [`foot_index`] are the only place where this order is written.
//!
//! Source of the fields and their order: Unitree's IDL (modules `unitree_go` and `unitree_api`) in unitree_sdk2 and
//! unitree_sdk2_python, which agrees with the `.msg` files of unitree_ros2.
//!
//! ```
//! use twinstep_model::{Joint, JointKind, Leg};
//! use twinstep_unitree::{LowCmd, decode, encode, motor_index};
//!
//! let mut command = LowCmd::stopped();
//! command.motor_cmd[motor_index(Joint { leg: Leg::FL, kind: JointKind::Calf })].kd = 3.0;
//! let payload = encode(&command.with_checksum());
//! let received: LowCmd = decode(&payload)?;
//! assert_eq!(received.motor_cmd[5].kd, 3.0);
//! assert!(received.check_checksum().is_ok());
//! # Ok::<(), twinstep_unitree::CdrError>(())
//! ```

pub mod crc;

mod cdr;
mod imu_state;
mod low_cmd;
mod low_state;
mod motor_order;
mod remote;
mod rpc;
mod sport_mode_state;
mod wireless_controller;

pub use cdr::{CdrError, FieldVisitor, Message, Primitive, decode, encode};
pub use crc::ChecksumError;
pub use imu_state::ImuState;
pub use low_cmd::{BmsCmd, HEAD, LOW_LEVEL, LowCmd, MotorCmd, NO_POSITION, NO_VELOCITY, SERVO};
pub use low_state::{BmsState, LowState, MotorState};
pub use motor_order::{NUM_MOTORS, foot_index, motor_index};
pub use remote::{Button, Remote, RemoteBytes};
pub use rpc::{RpcRequest, RpcResponse};
pub use sport_mode_state::{PathPoint, SportModeState};
pub use wireless_controller::WirelessController;
