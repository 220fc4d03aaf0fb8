//! [`RemoteVecEnv`]: a [`twinstep_model::VecEnv`] at the other end of Zenoh, a simulator's or the real robot's.
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
//! A request is repeated under its number until it is answered, and the server executes each number once: a lost reply,
//! a frozen server or a restarted router costs time, never a step. When nobody answers, [`ClientError`] says which of
//! the possible reasons it is.

mod error;
mod link;
mod remote_env;

pub use error::ClientError;
pub use link::{ConnectOptions, Connection};
pub use remote_env::{RemoteVecEnv, LeaseHandle};
