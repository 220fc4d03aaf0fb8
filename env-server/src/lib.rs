//! Serves vectorised robot environments over Zenoh: leases, exactly-once execution, shutdown.
//!
//! - [`Server`]: one run of a server. [`Server::start`] opens Zenoh and answers requests. [`Server::shutdown`] finishes
//!   the steps in progress and notifies the clients.
//! - [`EnvFactory`]: builds the environments of a lease. [`SimEnvFactory`] builds simulated ones from a [`Config`],
//!   [`TreeEnvFactory`] those of robots of any tree, [`AnyEnvFactory`] the one that the robot needs.
//! - [`FramePublisher`]: shows the robots to those who only look.
//! - [`Config`]: the config file with the tables `[server]`, `[task]`, `[sim]` and `[randomise]`.
//!
//! Zenoh's threads only put requests into mailboxes (`dispatch`). Each lease has a mailbox; so have `hello`, `lease` and
//! refused requests, which have threads of their own. The threads of one pool (`executor`) execute the requests of a mailbox in order, one at a time, and
//! send the replies. A repeated request therefore waits for the one in progress and gets its reply. The *lease manager*
//! grants leases, monitors the liveliness of clients and releases expired leases. The *worker* of a lease owns its
//! environments.

mod any_env_factory;
mod config;
mod dispatch;
mod env_factory;
mod executor;
mod frame_publisher;
mod lease_manager;
mod messages;
mod protection;
mod rollout;
mod server;
mod stop_listener;
mod tree_env;
mod tree_env_factory;
mod tree_readings;
mod worker;

pub use any_env_factory::{AnyEnvFactory, is_of_tree};
pub use config::{Config, ConfigFileError, ServerConfig};
pub use env_factory::{EnvFactory, EnvFactoryError, SimEnvFactory, check_measurable, task_env, task_spec};
pub use frame_publisher::FramePublisher;
pub use server::{Server, ServerError};
pub use tree_env_factory::TreeEnvFactory;
