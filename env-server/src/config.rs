//! The server's config file (TOML). Every command-line flag of the server has a key here.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use twinstep_effects::{ControlTable, parse_toml};
use twinstep_envs::{Randomisation, TaskConfig};
use twinstep_sim::SimConfig;

/// The config file of a server: tables, in which every key is optional.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Network settings, limits and robot of the server.
    pub server: ServerConfig,
    /// The task and its rewards.
    pub task: TaskConfig,
    /// Simulation settings.
    pub sim: SimConfig,
    /// Domain randomisation.
    pub randomise: Randomisation,
    /// Gains, rates, action scale and default pose: the contract of a policy. Its keys override those of the model file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub control: Option<ControlTable>,
}

/// The `[server]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// Name by which clients select the server. Default: the name of the robot, such as `go2`.
    pub name: Option<String>,
    /// Zenoh endpoint to listen at, such as `tcp/127.0.0.1:7447`. Port 0 selects a free port.
    pub listen: String,
    /// Zenoh endpoints of routers to connect to, in addition to listening.
    pub connect: Vec<String>,
    /// Zenoh configuration file (JSON5) for TLS, users and access control; `listen` and `connect` override its values.
    pub zenoh: Option<PathBuf>,
    /// Sends large messages through shared memory if client and server run on one machine.
    pub shared_memory: bool,
    /// Maximum total number of environments.
    pub envs: usize,
    /// Model file of the robot. Default: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Maximum number of environments that one client id may lease. Default: all.
    pub max_envs_per_client: Option<usize>,
    /// Maximum number of steps of a rollout; 0 for a server without rollouts.
    ///
    /// For each environment the server keeps the last trajectory and the encoded reply: for `walk` 0.7 kB per step,
    /// 380 MB if 4096 robots are leased and every lease requests 128 steps; twice as much if an episode ends in each.
    pub max_rollout_steps: usize,
    /// Time for which the environments of a disconnected client are kept [s].
    pub lease_grace_s: f64,
    /// Time without a request after which a lease is released even if its client is connected [s]. Default: never.
    pub lease_idle_s: Option<f64>,
    /// Seed of environments that the client does not seed. Default: a random seed at each start.
    pub seed: Option<u64>,
}

impl ServerConfig {
    /// Returns the name by which clients select the server of this robot.
    pub fn name_of(&self, robot: &str) -> String {
        self.name.clone().unwrap_or_else(|| as_name(robot))
    }
}

/// Longest name of a server.
const MAX_NAME: usize = 64;

/// Returns the name with `_` in place of everything that is not allowed in a name.
fn as_name(text: &str) -> String {
    let is_allowed = |character: char| character.is_ascii_alphanumeric() || matches!(character, '-' | '_');
    let name: String =
        text.chars().take(MAX_NAME).map(|character| if is_allowed(character) { character } else { '_' }).collect();
    if name.is_empty() { "_".to_owned() } else { name }
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            name: None,
            listen: "tcp/127.0.0.1:7447".to_owned(),
            connect: Vec::new(),
            zenoh: None,
            shared_memory: false,
            envs: 4096,
            model: None,
            max_envs_per_client: None,
            max_rollout_steps: 128,
            lease_grace_s: 10.0,
            lease_idle_s: None,
            seed: None,
        }
    }
}

impl ServerConfig {
    /// Returns the time for which the environments of a disconnected client are kept.
    pub fn lease_grace(&self) -> Duration {
        Duration::from_secs_f64(self.lease_grace_s)
    }
}

/// Reasons why a config file is rejected.
#[derive(Debug, thiserror::Error)]
pub enum ConfigFileError {
    /// The file could not be read.
    #[error("cannot read the config file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type.
    #[error("{name}: {message}")]
    Malformed {
        /// The file.
        name: String,
        /// Description of the error and its location.
        message: String,
    },
    /// A value is outside its range.
    #[error("`{field}` = {value} is not allowed: {allowed}")]
    OutOfRange {
        /// The key.
        field: &'static str,
        /// Its value.
        value: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// A setting of the task or of its randomisation is not allowed.
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

    /// Parses the text of a config file. Errors refer to the file as `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, ConfigFileError> {
        let config: Self = parse_toml(text)
            .map_err(|error| ConfigFileError::Malformed { name: name.to_owned(), message: error.to_string() })?;
        config.check()?;
        Ok(config)
    }

    /// Checks that every value is within its range.
    ///
    /// [`SimEnvFactory::new`](crate::SimEnvFactory::new) checks `sim`, because its limits depend on the robot.
    pub fn check(&self) -> Result<(), ConfigFileError> {
        let server = &self.server;
        let out_of_range = |field, value: String, allowed| Err(ConfigFileError::OutOfRange { field, value, allowed });
        if let Some(name) = server.name.as_ref().filter(|name| **name != as_name(name)) {
            return out_of_range("server.name", name.clone(), "1 to 64 letters, digits, - and _");
        }
        if !(1..=1_000_000).contains(&server.envs) {
            return out_of_range("server.envs", server.envs.to_string(), "1 to 1000000");
        }
        if !(0.0..=86_400.0).contains(&server.lease_grace_s) {
            return out_of_range("server.lease_grace_s", server.lease_grace_s.to_string(), "0 to 86400 s");
        }
        if server.max_envs_per_client == Some(0) {
            return out_of_range("server.max_envs_per_client", "0".to_owned(), "at least 1");
        }
        if server.max_rollout_steps > 1_000_000 {
            let steps = server.max_rollout_steps.to_string();
            return out_of_range("server.max_rollout_steps", steps, "0 (no rollouts) to 1000000");
        }
        if let Some(idle) = server.lease_idle_s.filter(|idle| !(1.0..=31_536_000.0).contains(idle)) {
            return out_of_range("server.lease_idle_s", idle.to_string(), "1 to 31536000 s");
        }
        self.task.check()?;
        self.randomise.check()?;
        let push_m_s = self.randomise.push_m_s;
        if self.randomise.has_pushes() && self.sim.base.is_fixed() {
            return out_of_range("randomise.push_m_s", format!("{push_m_s:?}"), "[0, 0] with a fixed base");
        }
        Ok(())
    }
}
