//! Records the robot's messages as they arrive.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::MessageHeader;

use super::write::SCHEMAS;
use crate::LogError;

/// Size of a chunk [bytes]: two seconds of messages. After a crash the complete chunks are readable.
const CHUNK_BYTES: u64 = 4 << 20;

/// Topic, name and definition of the messages with position and velocity of the base.
const SPORT_MODE_STATE: (&str, &str, &[u8]) =
    ("/sportmodestate", "unitree_go/msg/SportModeState", include_bytes!("schema/SportModeState.msg"));

/// Writes the robot's messages to an MCAP file, compressed with Zstandard. A crash costs the last two seconds.
pub struct McapRecorder {
    writer: mcap::Writer<BufWriter<File>>,
    path: PathBuf,
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
        let failed = |cause: McapError| LogError::Mcap { file: path.to_owned(), cause };
        let options = mcap::WriteOptions::new().profile("ros2").library("twinstep").chunk_size(Some(CHUNK_BYTES));
        let mut writer = options.create(BufWriter::new(file)).map_err(failed)?;
        let none = BTreeMap::new();
        let mut channel = |(topic, name, schema): (&str, &str, &[u8])| {
            let schema = writer.add_schema(name, "ros2msg", schema)?;
            writer.add_channel(schema, topic, "cdr", &none)
        };
        let states = channel(SCHEMAS[0]).map_err(failed)?;
        let commands = channel(SCHEMAS[1]).map_err(failed)?;
        let base_states = channel(SPORT_MODE_STATE).map_err(failed)?;
        let steps = writer.add_channel(0, "/twinstep/step", "json", &none).map_err(failed)?;
        Ok(Self { writer, path: path.to_owned(), channels: [states, commands, base_states, steps], messages: 0 })
    }

    /// Appends a message that arrived or was sent at `time_ns`.
    pub fn write(&mut self, topic: RecordedTopic, time_ns: u64, payload: &[u8]) -> Result<(), LogError> {
        let channel_id = self.channels[topic as usize];
        let header = MessageHeader { channel_id, sequence: self.messages, log_time: time_ns, publish_time: time_ns };
        self.messages = self.messages.wrapping_add(1);
        self.writer.write_to_known_channel(&header, payload).map_err(|cause| self.failed(cause))
    }

    /// Completes the file.
    pub fn finish(mut self) -> Result<(), LogError> {
        let summary = self.writer.finish().map(drop);
        summary.map_err(|cause| self.failed(cause))
    }

    fn failed(&self, cause: McapError) -> LogError {
        LogError::Mcap { file: self.path.clone(), cause }
    }
}
