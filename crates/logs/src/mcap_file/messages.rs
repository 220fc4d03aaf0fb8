//! Messages of an MCAP file: states and commands of the robot, and what `Log::write` adds to them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use mcap::McapError;
use mcap::records::{MessageHeader, Metadata, Record};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use twinstep_unitree::decode;

use super::clock::sender_times;
use super::lengths::{MAX_READ, check_texts, is_used, length_limit};
use super::{METADATA, PART_TOPIC, SegmentStart};
use crate::go2_message::{BaseState, LowCmd, LowState};
use crate::{LogError, Meta};

/// Content of an MCAP file that belongs to a log.
#[derive(Default)]
pub(crate) struct Recording {
    pub states: Vec<(u64, LowState)>,
    pub commands: Vec<(u64, LowCmd)>,
    pub base_states: Vec<(u64, BaseState)>,
    /// Clock of the sender of each base state [ns].
    base_clock: Vec<u64>,
    pub parts: Vec<(u64, SegmentStart)>,
    /// Metadata and column names, in a file that `Log::write` wrote.
    pub own_meta: Option<(Meta, Vec<String>)>,
    schemas: BTreeMap<u16, String>,
    pub channels: BTreeMap<u16, Channel>,
    /// True if the file ends before its last record.
    pub truncated: bool,
}

/// Channel of the file, with the number of its messages.
pub(crate) struct Channel {
    pub topic: String,
    pub content: Content,
    pub messages: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Content {
    State,
    Command,
    BaseState,
    Part,
    Other,
}

impl Recording {
    /// Reads the content of `file`.
    pub fn read(file: &Path) -> Result<Recording, LogError> {
        let refused = |cause| LogError::Read { file: file.into(), cause };
        let damaged = |cause| LogError::Mcap { file: file.into(), cause };
        let opened = File::open(file).map_err(refused)?;
        let limit = length_limit(opened.metadata().map_err(refused)?.len());
        let mut source = BufReader::new(opened);
        let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
        let mut reader = LinearReader::new_with_options(options.with_record_length_limit(limit));
        let mut recording = Recording::default();
        while let Some(event) = reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(bytes)) => {
                    let got = source.read(reader.insert(bytes.min(MAX_READ))).map_err(refused)?;
                    reader.notify_read(got);
                }
                Ok(LinearReadEvent::Record { data, opcode }) if is_used(opcode) => {
                    let record = check_texts(opcode, data).and_then(|()| mcap::parse_record(opcode, data));
                    recording.add(file, record.map_err(damaged)?)?;
                }
                Ok(LinearReadEvent::Record { .. }) => {}
                // A recorder that was killed or lost power wrote whole chunks up to that time. What follows them may be cut off,
                // a length that was never written, or zeros.
                Err(_) if !recording.states.is_empty() => {
                    recording.truncated = true;
                    break;
                }
                Err(cause) => return Err(damaged(cause)),
            }
        }
        Ok(recording)
    }

    fn add(&mut self, file: &Path, record: Record<'_>) -> Result<(), LogError> {
        match record {
            Record::Schema { header, .. } => drop(self.schemas.insert(header.id, header.name)),
            Record::Channel(channel) if !self.channels.contains_key(&channel.id) => {
                let content = self.content(file, &channel)?;
                self.channels.insert(channel.id, Channel { topic: channel.topic, content, messages: 0 });
            }
            Record::Message { header, data } => self.message(file, &header, &data)?,
            Record::Metadata(metadata) if metadata.name == METADATA => {
                self.own_meta = Some(read_metadata(file, &metadata)?);
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the content of a channel. Fails if a topic of the robot has messages of another type.
    fn content(&self, file: &Path, channel: &mcap::records::Channel) -> Result<Content, LogError> {
        if channel.topic == PART_TOPIC {
            return Ok(Content::Part);
        }
        let (content, name) = match channel.topic.trim_start_matches('/') {
            "lowstate" | "rt/lowstate" => (Content::State, "LowState"),
            "lowcmd" | "rt/lowcmd" => (Content::Command, "LowCmd"),
            "sportmodestate" | "rt/sportmodestate" => (Content::BaseState, "SportModeState"),
            _ => return Ok(Content::Other),
        };
        let schema = self.schemas.get(&channel.schema_id).map_or("", String::as_str);
        let ours = schema.is_empty() || (schema.contains("unitree_go") && schema.contains(name));
        if !ours || !channel.message_encoding.eq_ignore_ascii_case("cdr") {
            let found = format!("{schema} as {}", channel.message_encoding).trim_start().to_owned();
            return Err(LogError::McapType { file: file.into(), topic: channel.topic.clone(), found, name });
        }
        // A bridge may record the same content twice: the first channel is used.
        let is_copy = self.channels.values().any(|other| other.content == content && other.topic != channel.topic);
        Ok(if is_copy { Content::Other } else { content })
    }

    fn message(&mut self, file: &Path, header: &MessageHeader, data: &[u8]) -> Result<(), LogError> {
        let Some(channel) = self.channels.get_mut(&header.channel_id) else {
            let cause = McapError::UnknownChannel(header.sequence, header.channel_id);
            return Err(LogError::Mcap { file: file.into(), cause });
        };
        channel.messages += 1;
        let (topic, message) = (channel.topic.clone(), channel.messages);
        let refused = |cause| LogError::McapMessage { file: file.into(), topic, message, cause };
        let time = header.log_time;
        match channel.content {
            Content::State => {
                let state: twinstep_unitree::LowState = decode(data).map_err(refused)?;
                self.states.push((time, state.into()));
            }
            Content::Command => {
                let command: twinstep_unitree::LowCmd = decode(data).map_err(refused)?;
                self.commands.push((time, command.into()));
            }
            Content::BaseState => {
                let state: twinstep_unitree::SportModeState = decode(data).map_err(refused)?;
                self.base_clock.push(u64::from(state.sec.unsigned_abs()) * 1_000_000_000 + u64::from(state.nanosec));
                self.base_states.push((time, BaseState { position: state.position, velocity: state.velocity }));
            }
            Content::Part => {
                let part = serde_json::from_slice(data);
                self.parts.push((time, part.map_err(|cause| LogError::MetaSyntax { file: file.into(), cause })?));
            }
            Content::Other => {}
        }
        Ok(())
    }

    /// Sorts all messages by time.
    pub fn order(&mut self) {
        let arrivals: Vec<u64> = self.base_states.iter().map(|(time, _)| *time).collect();
        for ((time, _), sent) in self.base_states.iter_mut().zip(sender_times(&arrivals, &self.base_clock)) {
            *time = sent;
        }
        self.base_states.sort_by_key(|(time, _)| *time);
        self.states.sort_by_key(|(time, _)| *time);
        self.commands.sort_by_key(|(time, _)| *time);
        self.parts.sort_by_key(|(time, _)| *time);
    }

    /// Returns the topics with the number of their messages as text, for errors.
    pub fn topics(&self) -> String {
        let topic = |channel: &Channel| format!("`{}` ({} messages)", channel.topic, channel.messages);
        let topics: Vec<_> = self.channels.values().map(topic).collect();
        if topics.is_empty() { "none".to_owned() } else { topics.join(", ") }
    }
}

fn read_metadata(file: &Path, metadata: &Metadata) -> Result<(Meta, Vec<String>), LogError> {
    let wrong = |cause| LogError::MetaSyntax { file: file.into(), cause };
    let text = |key: &str| metadata.metadata.get(key).map_or("", String::as_str);
    let meta: Meta = serde_json::from_str(text("meta")).map_err(wrong)?;
    meta.check(file)?;
    Ok((meta, serde_json::from_str(text("columns")).map_err(wrong)?))
}
