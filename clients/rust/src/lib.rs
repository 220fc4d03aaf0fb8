//! [`RemoteVecEnv`]: a [`twinstep_model::VecEnv`] whose environments run on a server reached over Zenoh.
//!
//! ```no_run
//! use twinstep_client::{ConnectOptions, RemoteVecEnv};
//! use twinstep_model::{ResetRequest, VecEnv};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut env = RemoteVecEnv::connect(&ConnectOptions::new("tcp/127.0.0.1:7447", 64))?;
//! env.reset(&ResetRequest::seeded(1, 64))?;
//! let batch = env.step(&vec![0.0; 64 * env.spec().action_len()])?;
//! println!("{:?}", batch.reward);
//! # Ok(())
//! # }
//! ```
//!
//! [`GroupedVecEnv`] keeps several groups of environments stepping while the agent computes actions.
//!
//! [`ShardedVecEnv`] divides environments among several servers, and continues when one of them is lost.
//!
//! [`RemoteVecEnv::rollout`] runs a policy on the server, next to its robots; [`RemoteCollector`] does it for a learner.
//!
//! [`RobotWatch`] sees the robots of a server without environments of its own.
//!
//! The client repeats a request with the same sequence number until a reply arrives. The server executes each number
//! once. A lost reply, an unresponsive server or a restarted router costs time, but no step is lost or executed twice.
//! If no reply arrives, [`ClientError`] contains the reason.

mod connection;
mod discovery;
mod error;
mod grouped_env;
mod merge;
mod options;
mod recovery;
mod remote_collector;
mod remote_env;
mod robot_watch;
mod server_process;
mod session;
mod shard;
mod sharded_env;
mod stop_channel;

pub use connection::Connection;
pub use discovery::{Discovery, ServerInfo};
pub use error::{ClientError, Reachability};
pub use grouped_env::GroupedVecEnv;
pub use options::ConnectOptions;
pub use remote_collector::RemoteCollector;
pub use remote_env::{LeaseHandle, RemoteVecEnv};
pub use robot_watch::{FrameSubscription, RobotWatch};
pub use server_process::ServerProcess;
pub use sharded_env::ShardedVecEnv;
pub use stop_channel::stop_robot;
pub use twinstep_protocol::Secret;
