//! Serves vectorised Go2 environments over Zenoh: leases, exactly-once execution, shutdown.
//!
//! - [`Server`]: one run of a server. [`Server::start`] opens Zenoh and answers requests. [`Server::shutdown`] finishes
//!   the steps in progress and notifies the clients.
//! - [`EnvFactory`]: builds the environments of a lease. [`SimEnvFactory`] builds simulated ones from a [`Config`].
//! - [`Config`]: the config file with the tables `[server]`, `[task]`, `[sim]` and `[randomise]`.
//!
//! There are three kinds of thread. Zenoh's threads only enqueue requests. The *lease manager* grants leases and
//! monitors the liveliness of clients. One *worker* per lease owns its environments and executes its requests in order.
//! A repeated request therefore waits for the one in progress and gets its reply.

mod config;
mod env_factory;
mod lease_manager;
mod messages;
mod random;
mod server;
mod worker;

pub use config::{Config, ConfigFileError, ServerConfig};
pub use env_factory::{EnvFactory, EnvFactoryError, SimEnvFactory};
pub use server::{Server, ServerError};
