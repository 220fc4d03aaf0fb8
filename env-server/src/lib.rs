//! Vectorised Go2 environments behind Zenoh: sessions and leases, exactly-once stepping, shutdown.
//!
//! - [`Server`]: one process start. [`Server::start`] opens Zenoh and answers; [`Server::stop`] finishes the steps in
//!   progress and tells the clients.
//! - [`Host`]: who builds the environments that a client asked for; [`SimHost`] builds them from a [`Config`].
//! - [`Config`]: the config file with `[server]`, `[task]`, `[sim]` and `[randomise]`.
//!
//! Three kinds of thread: Zenoh's own only enqueue; the *desk* grants leases and watches who lives; one *worker* a lease
//! owns its environments and does what it is asked in order, so that a repeated request waits for the one in progress
//! and then gets its reply again.

mod config;
mod desk;
mod host;
mod server;
mod worker;

pub use config::{Config, ConfigFileError, ServerConfig};
pub use host::{EnvFactory, EnvFactoryError, SimEnvFactory};
pub use server::{Server, ServerError};
