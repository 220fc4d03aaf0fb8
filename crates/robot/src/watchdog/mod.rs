//! The watchdog of the motors: a process of its own that damps them when the control loop stops.
//!
//! The control loop is one thread of a process that serves a network and a terminal. The process may be killed, suspended,
//! run out of memory or panic, and the motors keep the last command that reached them. So [`WatchdogLink::start`] starts a
//! second process, which can do one thing: send damping. It has its own POSIX session, so that no signal of a terminal
//! reaches it, locked memory and a real-time priority above that of the control loop. It allocates nothing after its
//! start, and it receives nothing from the network: its only input is a socket pair with the control loop.
//!
//! | [`Message`] of the control loop | meaning |
//! |---|---|
//! | `Guard` | the writer of the commands, the addresses of its readers, the payload that damps |
//! | `Beat` | the control loop has sent a command |
//! | `Release` | the robot is not armed any more |
//!
//! [`WatchdogMachine`] decides. It *guards* from `Guard` to `Release`. It *takes over* when no `Beat` has arrived for
//! `safety.watchdog_timeout_ms`, or when the control loop's end of the socket is closed. Then it sends damping every 2 ms until a
//! `Guard` of a later generation or `Release`; after the end of the control loop for 1.5 s, so that the robot lies.
//!
//! # Two writers never disagree
//! The datagrams have the writer's id and sequence numbers from [`FIRST_NUMBER`] on, which the control loop never reaches. A
//! reader ignores numbers below the last one that it has received, so after the first datagram of the watchdog no command of
//! the control loop counts, whatever it does. The operator arms again: that creates a new writer, and a new generation.
//!
//! The control loop supervises the watchdog in turn: a watchdog that ends or does not run is a fault ([`Watchdog::Missing`]).

mod link;
mod machine;
mod message;
mod process;

pub use link::WatchdogLink;
pub use machine::{Mode, WatchdogMachine};
pub use message::{Guard, MAX_READERS, Message, Status};
pub use process::run;

pub use crate::command_datagram::FIRST_NUMBER;

/// What the control loop knows of the watchdog.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Watchdog {
    /// It has ended or does not run.
    #[default]
    Missing,
    /// It runs, and has no writer or no reader to send to.
    Idle,
    /// It damps the motors if the control loop stops.
    Guarding,
    /// It damps the motors, because the control loop stopped.
    TookOver,
}
