//! How client and server of a measurement exchange messages.

use std::io::Write;

use tempfile::NamedTempFile;
use twinstep_client::{ConnectOptions, ServerProcess};

use crate::error::{BenchError, failed};

/// A link between a client and its server on this machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Link {
    /// TCP, with the settings of Twinstep.
    Tcp,
    /// Shared memory.
    SharedMemory,
    /// TCP with Zenoh's low-latency transport, which cannot send more than 64 KiB.
    LowLatency,
}

/// A server, and the configuration file of its Zenoh session and that of its client.
pub struct Server {
    process: ServerProcess,
    link: Link,
    zenoh: Option<NamedTempFile>,
}

impl Link {
    /// Returns the addition to the name of a case.
    pub fn suffix(self) -> &'static str {
        match self {
            Self::Tcp => "",
            Self::SharedMemory => ", shared memory",
            Self::LowLatency => ", low latency",
        }
    }

    /// Starts a server with these flags.
    pub fn server(self, flags: &[&str]) -> Result<Server, BenchError> {
        let mut flags = flags.to_vec();
        let mut zenoh = None;
        if self == Self::LowLatency {
            let mut file = NamedTempFile::with_suffix(".json5").map_err(failed)?;
            file.write_all(include_bytes!("../../../examples/low_latency.json5")).map_err(failed)?;
            zenoh = Some(file);
        }
        let path = zenoh.as_ref().map(|file| file.path().display().to_string());
        if let Some(path) = &path {
            flags.extend(["--zenoh", path]);
        }
        if self == Self::SharedMemory {
            flags.push("--shared-memory");
        }
        Ok(Server { process: ServerProcess::start(&flags).map_err(failed)?, link: self, zenoh })
    }
}

impl Server {
    /// Returns the options of a client with this number of environments.
    pub fn options(&self, num_envs: usize) -> ConnectOptions {
        ConnectOptions {
            shared_memory: self.link == Link::SharedMemory,
            zenoh: self.zenoh.as_ref().map(|file| file.path().to_owned()),
            ..ConnectOptions::new(&self.process.endpoint, num_envs)
        }
    }
}
