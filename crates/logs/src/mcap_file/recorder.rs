//! Records the robot's messages as they arrive.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::MessageHeader;

use super::whole_records::WholeRecords;
use super::write::SCHEMAS;
use crate::LogError;

/// Time after which a chunk is written, by the times of its messages [ns]. A crash costs this time and that of writing.
const CHUNK_NS: u64 = 500_000_000;

/// Topic, name and definition of the messages with position and velocity of the base.
const SPORT_MODE_STATE: (&str, &str, &[u8]) =
    ("/sportmodestate", "unitree_go/msg/SportModeState", include_bytes!("schema/SportModeState.msg"));

/// Writes the robot's messages to an MCAP file, compressed with Zstandard. A crash of the process or of the
/// computer costs the last second.
pub struct McapRecorder {
    writer: mcap::Writer<WholeRecords>,
    path: PathBuf,
    /// Time of the first message of the present chunk [ns].
    chunk_start: Option<u64>,
    channels: [u16; 4],
    messages: u32,
}

/// Kind of a recorded message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordedTopic {
    /// `/lowstate`, CDR.
    State,
    /// `/lowcmd`, CDR.
    Command,
    /// `/sportmodestate`, CDR.
    BaseState,
    /// `/twinstep/step`, JSON: what a client asked for in a step, and what it got.
    Step,
}

impl McapRecorder {
    /// Creates the file, which must not exist.
    pub fn create(path: &Path) -> Result<Self, LogError> {
        let file = File::create_new(path).map_err(|cause| LogError::Write { file: path.to_owned(), cause })?;
        let failed = |cause: McapError| failed(path, cause);
        let options = mcap::WriteOptions::new().profile("ros2").library("twinstep").chunk_size(None);
        let mut writer = options.create(WholeRecords::new(file)).map_err(failed)?;
        let none = BTreeMap::new();
        let mut channel = |(topic, name, schema): (&str, &str, &[u8])| {
            let schema = writer.add_schema(name, "ros2msg", schema)?;
            writer.add_channel(schema, topic, "cdr", &none)
        };
        let states = channel(SCHEMAS[0]).map_err(failed)?;
        let commands = channel(SCHEMAS[1]).map_err(failed)?;
        let base_states = channel(SPORT_MODE_STATE).map_err(failed)?;
        let steps = writer.add_channel(0, "/twinstep/step", "json", &none).map_err(failed)?;
        let channels = [states, commands, base_states, steps];
        Ok(Self { writer, path: path.to_owned(), chunk_start: None, channels, messages: 0 })
    }

    /// Appends a message that arrived or was sent at `time_ns`.
    pub fn write(&mut self, topic: RecordedTopic, time_ns: u64, payload: &[u8]) -> Result<(), LogError> {
        let channel_id = self.channels[topic as usize];
        let header = MessageHeader { channel_id, sequence: self.messages, log_time: time_ns, publish_time: time_ns };
        self.messages = self.messages.wrapping_add(1);
        self.writer.write_to_known_channel(&header, payload).map_err(|cause| self.failed(cause))?;
        let start = *self.chunk_start.get_or_insert(time_ns);
        if time_ns.saturating_sub(start) >= CHUNK_NS { self.flush() } else { Ok(()) }
    }

    /// Writes the messages so far to the disk.
    pub fn flush(&mut self) -> Result<(), LogError> {
        self.chunk_start = None;
        self.writer.flush().map_err(|cause| self.failed(cause))
    }

    /// Completes the file.
    pub fn finish(mut self) -> Result<(), LogError> {
        let summary = self.writer.finish().map(drop);
        summary.map_err(|cause| self.failed(cause))?;
        let Self { writer, path, .. } = self;
        writer.into_inner().flush().map_err(|cause| LogError::Write { file: path, cause })
    }

    fn failed(&self, cause: McapError) -> LogError {
        failed(&self.path, cause)
    }
}

/// Returns the error of a file that cannot be written. The usual cause is the disk.
fn failed(path: &Path, cause: McapError) -> LogError {
    match cause {
        McapError::Io(cause) => LogError::Write { file: path.to_owned(), cause },
        cause => LogError::Mcap { file: path.to_owned(), cause },
    }
}
