//! The formats that are fuzzed, with the limit of memory of each.

use std::path::{Path, PathBuf};

/// Result of reading an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The bytes are not of this format.
    Refused,
    /// The bytes are of this format, but a later check refused their values.
    Decoded,
    /// The input was accepted.
    Accepted,
}

impl Outcome {
    /// Returns the outcome of a decoded input whose later checks had this result.
    pub fn checked(is_accepted: bool) -> Self {
        if is_accepted { Outcome::Accepted } else { Outcome::Decoded }
    }
}

/// Kind of message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are those in SPEC.md")]
pub enum Message {
    HelloRequest,
    HelloReply,
    LeaseRequest,
    LeaseReply,
    ResetRequest,
    ResetReply,
    StepRequest,
    StepReply,
    RolloutRequest,
    RolloutReply,
    CloseRequest,
    CloseReply,
    RenderRequest,
    RenderReply,
    Error,
}

impl Message {
    /// All kinds, with the beginning of the names of their golden files.
    pub const ALL: [(Message, &str); 15] = [
        (Message::HelloRequest, "hello_request"),
        (Message::HelloReply, "hello_reply"),
        (Message::LeaseRequest, "lease_request"),
        (Message::LeaseReply, "lease_reply"),
        (Message::ResetRequest, "reset_request"),
        (Message::ResetReply, "reset_reply"),
        (Message::StepRequest, "step_request"),
        (Message::StepReply, "step_reply"),
        (Message::RolloutRequest, "rollout_request"),
        (Message::RolloutReply, "rollout_reply"),
        (Message::CloseRequest, "close_request"),
        (Message::CloseReply, "close_reply"),
        (Message::RenderRequest, "render_request"),
        (Message::RenderReply, "render_reply"),
        (Message::Error, "error"),
    ];
}

/// Format of messages or files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// A message of the protocol.
    Wire(Message),
    /// Model file (TOML).
    Model,
    /// Robot in URDF.
    Urdf,
    /// Robot in MJCF.
    Mjcf,
    /// Config file of a server (TOML).
    Config,
    /// Log as CSV.
    Csv,
    /// Log as compressed CSV.
    CsvGz,
    /// Log as Parquet.
    Parquet,
    /// Log or recording as MCAP.
    Mcap,
    /// Metadata of a log (JSON).
    Meta,
    /// Ensemble of actuator networks (safetensors).
    Ensemble,
    /// Interrupted training of an ensemble (safetensors).
    Training,
    /// Velocity commands (CSV).
    Commands,
    /// Interrupted identification (JSON).
    Search,
    /// Policy (safetensors).
    Policy,
    /// Policy as an ONNX model.
    Onnx,
    /// Mapping of a foreign policy (TOML).
    Mapping,
    /// Config of the training of a foreign policy (YAML).
    PolicyConfig,
    /// Config of legged_gym (Python).
    PolicyConfigPy,
    /// Map of the columns of a log (TOML).
    ColumnMap,
    /// Recording of rosbag2 in the format of SQLite.
    Bag,
    /// State of the robot, as its DDS topic has it (CDR).
    LowState,
    /// Response of a service of the robot (CDR).
    RpcResponse,
    /// Zenoh configuration (JSON5).
    Zenoh,
    /// Arguments of the command line that are parsed: scopes, effects, joints, secrets; and keys of the protocol.
    Argument,
}

/// Formats of files, with their names.
const FILES: [(Format, &str); 24] = [
    (Format::Model, "model_file"),
    (Format::Urdf, "robot_urdf"),
    (Format::Mjcf, "robot_mjcf"),
    (Format::Config, "server_config"),
    (Format::Csv, "log_csv"),
    (Format::CsvGz, "log_csv_gz"),
    (Format::Parquet, "log_parquet"),
    (Format::Mcap, "log_mcap"),
    (Format::Meta, "log_meta"),
    (Format::Ensemble, "ensemble"),
    (Format::Training, "training"),
    (Format::Commands, "commands_csv"),
    (Format::Search, "search"),
    (Format::Policy, "policy"),
    (Format::Onnx, "policy_onnx"),
    (Format::Mapping, "policy_mapping"),
    (Format::PolicyConfig, "policy_config"),
    (Format::PolicyConfigPy, "policy_config_py"),
    (Format::ColumnMap, "log_map"),
    (Format::Bag, "log_db3"),
    (Format::LowState, "robot_low_state"),
    (Format::RpcResponse, "robot_rpc_response"),
    (Format::Zenoh, "zenoh_config"),
    (Format::Argument, "argument"),
];

/// Maximum memory that reading an input may need.
#[derive(Clone, Copy, Debug)]
pub struct MemoryLimit {
    /// Bytes for an empty input.
    pub constant: usize,
    /// Bytes per byte of input.
    pub factor: usize,
}

impl MemoryLimit {
    /// Returns the limit for an input of `length` bytes.
    pub fn of(self, length: usize) -> usize {
        self.constant + self.factor * length
    }
}

impl Format {
    /// Returns all formats: messages, then files.
    pub fn all() -> Vec<Format> {
        let messages = Message::ALL.into_iter().map(|(message, _)| Format::Wire(message));
        messages.chain(FILES.into_iter().map(|(format, _)| format)).collect()
    }

    /// Returns the name, as in `--format` and in the names of saved inputs.
    pub fn name(self) -> &'static str {
        match self {
            Format::Wire(message) => Message::ALL[message as usize].1,
            file => FILES.into_iter().find(|(format, _)| *format == file).map_or("", |(_, name)| name),
        }
    }

    /// Returns the format of this name.
    pub fn named(name: &str) -> Option<Format> {
        Self::all().into_iter().find(|format| format.name() == name)
    }

    /// Returns true for messages of the protocol.
    pub fn is_message(self) -> bool {
        matches!(self, Format::Wire(_))
    }

    /// Returns true if changes to words and lines are useful.
    pub fn is_text(self) -> bool {
        use Format::{
            Argument, ColumnMap, Commands, Config, Csv, Mapping, Meta, Mjcf, Model, PolicyConfig, PolicyConfigPy,
            Search, Urdf, Zenoh,
        };
        matches!(
            self,
            Model
                | Urdf
                | Mjcf
                | Config
                | Csv
                | Commands
                | Mapping
                | Meta
                | Search
                | Zenoh
                | Argument
                | PolicyConfig
                | PolicyConfigPy
                | ColumnMap
        )
    }

    /// Returns the maximum memory that reading an input may need.
    pub fn memory_limit(self) -> MemoryLimit {
        const MIB: usize = 1 << 20;
        match self {
            // serde reserves up to 1 MiB for an array of the length that a message claims.
            Format::Wire(_) => MemoryLimit { constant: MIB + (64 << 10), factor: 64 },
            // The Parquet library reserves, but does not touch, the length that a page claims: up to 2 GiB.
            Format::Parquet => MemoryLimit { constant: 2052 * MIB, factor: 256 },
            // An operation may compute 4 million numbers, and a network 16 million.
            Format::Onnx => MemoryLimit { constant: 160 * MIB, factor: 256 },
            // A chunk may have 16 MiB, or 1024 times the length of a compressed file.
            Format::Mcap => MemoryLimit { constant: 20 * MIB, factor: 1280 },
            _ => MemoryLimit { constant: 4 * MIB, factor: 256 },
        }
    }
}

/// Returns the root of the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Returns the content of the files of a folder of the repository with this beginning and ending of the name, by name.
pub fn examples_in(folder: &str, beginning: &str, ending: &str) -> Vec<Vec<u8>> {
    let folder = root().join(folder);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut paths: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.sort();
    let is_example = |name: &str| name.starts_with(beginning) && name.ends_with(ending);
    paths.retain(|path| path.file_name().and_then(|name| name.to_str()).is_some_and(is_example));
    paths.iter().map(|path| std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))).collect()
}
