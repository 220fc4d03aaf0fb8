//! The server's config file (TOML). Every command-line flag has its key here.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use twinstep_envs::{Randomisation, TaskConfig};
use twinstep_sim::SimConfig;

/// A config file: four tables, all keys optional.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where and for whom the server answers.
    pub server: ServerConfig,
    /// What the robots are asked to do.
    pub task: TaskConfig,
    /// How they are simulated.
    pub sim: SimConfig,
    /// How they differ from each other.
    pub randomise: Randomisation,
}

/// The `[server]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// The robot's name; clients find the server by it.
    pub name: String,
    /// Where the server listens: a Zenoh endpoint such as `tcp/127.0.0.1:7447`; port 0 takes a free one.
    pub listen: String,
    /// Routers to connect to, in place of listening only.
    pub connect: Vec<String>,
    /// Zenoh configuration (JSON5) for TLS, users and access control; `listen` and `connect` are put into it.
    pub zenoh: Option<PathBuf>,
    /// Move large messages through shared memory when both ends are on one machine.
    pub shared_memory: bool,
    /// The most environments hosted in all.
    pub envs: usize,
    /// Model file of the robot; the ideal Go2 without.
    pub model: Option<PathBuf>,
    /// Time that a lost client's environments wait for it [s].
    pub lease_grace_s: f64,
    /// Seed of environments that no client seeds; drawn anew at each start without.
    pub seed: Option<u64>,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            name: "go2".to_owned(),
            listen: "tcp/127.0.0.1:7447".to_owned(),
            connect: Vec::new(),
            zenoh: None,
            shared_memory: false,
            envs: 4096,
            model: None,
            lease_grace_s: 10.0,
            seed: None,
        }
    }
}

impl ServerConfig {
    /// Time that a lost client's environments wait for it.
    pub fn lease_grace(&self) -> Duration {
        Duration::from_secs_f64(self.lease_grace_s)
    }
}

/// Why a config was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigFileError {
    /// The file could not be read.
    #[error("cannot read the config file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type.
    #[error("{name}: {message}")]
    Malformed {
        /// The file.
        name: String,
        /// What is wrong and where.
        message: String,
    },
    /// A value is outside its range.
    #[error("`{field}` = {value} is not allowed: {allowed}")]
    OutOfRange {
        /// The key.
        field: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A setting of the task or its randomisation is not allowed.
    #[error(transparent)]
    Task(#[from] twinstep_envs::ConfigError),
}

impl Config {
    /// Reads a config file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ConfigFileError> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigFileError::Unreadable { path: path.to_owned(), source })?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Reads the text of a config file; errors call it `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, ConfigFileError> {
        let config: Self = toml::from_str(text)
            .map_err(|error| ConfigFileError::Malformed { name: name.to_owned(), message: error.to_string() })?;
        config.check()?;
        Ok(config)
    }

    /// Fails if a value is outside its range. `sim` is checked against the robot's drive when environments are built.
    pub fn check(&self) -> Result<(), ConfigFileError> {
        let server = &self.server;
        let out_of_range = |field, value: String, allowed| Err(ConfigFileError::OutOfRange { field, value, allowed });
        let is_name = |character: char| character.is_ascii_alphanumeric() || matches!(character, '-' | '_');
        if server.name.is_empty() || server.name.len() > 64 || !server.name.chars().all(is_name) {
            return out_of_range("server.name", server.name.clone(), "1 to 64 letters, digits, - and _");
        }
        if !(1..=1_000_000).contains(&server.envs) {
            return out_of_range("server.envs", server.envs.to_string(), "1 to 1000000");
        }
        if !(0.0..=86_400.0).contains(&server.lease_grace_s) {
            return out_of_range("server.lease_grace_s", server.lease_grace_s.to_string(), "0 to 86400 s");
        }
        self.task.check()?;
        self.randomise.check()?;
        Ok(())
    }
}
