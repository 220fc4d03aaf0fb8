//! Messages of an MCAP file: states and commands of the robot, and what `Log::write` adds to them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::{MessageHeader, Metadata, Record};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use twinstep_unitree::decode;

use super::clock::sender_times;
use super::lengths::{MAX_READ, check_texts, is_used, length_limit};
use super::sqlite::{self, Entry};
use super::{METADATA, PART_TOPIC, SegmentStart};
use crate::go2_message::{BaseState, LowCmd, LowState};
use crate::{LogError, Meta};

/// Messages of one robot, in the order of arrival.
#[derive(Default)]
pub(crate) struct Messages {
    pub states: Vec<(u64, LowState)>,
    pub commands: Vec<(u64, LowCmd)>,
    pub base_states: Vec<(u64, BaseState)>,
    /// Clock of the sender of each base state [ns].
    base_clock: Vec<u64>,
}

/// Content of the files of a recording that belongs to a log.
#[derive(Default)]
pub(crate) struct Recording {
    /// By the namespace of the topics, such as `go2` for `/go2/lowstate`.
    robots: BTreeMap<String, Messages>,
    pub parts: Vec<(u64, SegmentStart)>,
    /// Metadata and column names, in a file that `Log::write` wrote.
    pub own_meta: Option<(Meta, Vec<String>)>,
    /// Number of the present file. Every file has its own channels.
    file: usize,
    schemas: BTreeMap<u16, String>,
    pub channels: BTreeMap<(usize, u16), Channel>,
    /// True if a file ends before its last record.
    pub truncated: bool,
}

/// Channel of a file, with the number of its messages.
pub(crate) struct Channel {
    pub topic: String,
    pub namespace: String,
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
    /// Reads the content of the files of a recording, in the order of their names.
    pub fn read(files: &[PathBuf]) -> Result<Recording, LogError> {
        let mut recording = Recording::default();
        for (number, file) in files.iter().enumerate() {
            (recording.file, recording.schemas) = (number, BTreeMap::new());
            if file.extension().is_some_and(|end| end == "db3") {
                sqlite::read(file, |entry| match entry {
                    Entry::Topic { id, topic, kind, encoding } => {
                        recording.open_channel(file, id, topic, (&kind, &encoding))
                    }
                    Entry::Message { topic, time, data } => recording.message(file, topic, time, data),
                })?;
            } else {
                recording.read_mcap(file)?;
            }
        }
        Ok(recording)
    }

    fn read_mcap(&mut self, file: &Path) -> Result<(), LogError> {
        let refused = |cause| LogError::Read { file: file.into(), cause };
        let damaged = |cause| LogError::Mcap { file: file.into(), cause };
        let opened = File::open(file).map_err(refused)?;
        let limit = length_limit(opened.metadata().map_err(refused)?.len());
        let mut source = BufReader::new(opened);
        let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
        let mut reader = LinearReader::new_with_options(options.with_record_length_limit(limit));
        while let Some(event) = reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(bytes)) => {
                    let got = source.read(reader.insert(bytes.min(MAX_READ))).map_err(refused)?;
                    reader.notify_read(got);
                }
                Ok(LinearReadEvent::Record { data, opcode }) if is_used(opcode) => {
                    let record = check_texts(opcode, data).and_then(|()| mcap::parse_record(opcode, data));
                    self.add(file, record.map_err(damaged)?)?;
                }
                Ok(LinearReadEvent::Record { .. }) => {}
                // A recorder that was killed or lost power wrote whole chunks up to that time. What follows them may be cut off,
                // a length that was never written, or zeros.
                Err(_) if self.robots.values().any(|robot| !robot.states.is_empty()) => {
                    self.truncated = true;
                    break;
                }
                Err(cause) => return Err(damaged(cause)),
            }
        }
        Ok(())
    }

    fn add(&mut self, file: &Path, record: Record<'_>) -> Result<(), LogError> {
        match record {
            Record::Schema { header, .. } => drop(self.schemas.insert(header.id, header.name)),
            Record::Channel(channel) if !self.channels.contains_key(&(self.file, channel.id)) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                self.open_channel(file, channel.id, channel.topic, (&schema, &channel.message_encoding))?;
            }
            Record::Message { header: MessageHeader { channel_id, sequence, log_time, .. }, data } => {
                if !self.channels.contains_key(&(self.file, channel_id)) {
                    let cause = McapError::UnknownChannel(sequence, channel_id);
                    return Err(LogError::Mcap { file: file.into(), cause });
                }
                self.message(file, channel_id, log_time, &data)?;
            }
            Record::Metadata(metadata) if metadata.name == METADATA => {
                self.own_meta = Some(read_metadata(file, &metadata)?);
            }
            _ => {}
        }
        Ok(())
    }

    /// Adds a channel. Fails if a topic of the robot has messages of another type.
    fn open_channel(
        &mut self,
        file: &Path,
        id: u16,
        topic: String,
        (schema, encoding): (&str, &str),
    ) -> Result<(), LogError> {
        let (namespace, content, name) = kind(&topic);
        if content != Content::Other && content != Content::Part {
            let ours = schema.is_empty() || (schema.contains("unitree_go") && schema.contains(name));
            if !ours || !encoding.eq_ignore_ascii_case("cdr") {
                // Another robot may have a topic of the same name.
                if !namespace.is_empty() {
                    self.insert(id, topic, namespace, Content::Other);
                    return Ok(());
                }
                let found = format!("{schema} as {encoding}").trim_start().to_owned();
                return Err(LogError::McapType { file: file.into(), topic, found, name });
            }
        }
        // A bridge may record the same content twice: the first channel is used.
        let is_same =
            |other: &Channel| other.content == content && other.namespace == namespace && other.topic != topic;
        let content = if self.channels.values().any(is_same) { Content::Other } else { content };
        self.insert(id, topic, namespace, content);
        Ok(())
    }

    fn insert(&mut self, id: u16, topic: String, namespace: String, content: Content) {
        self.channels.insert((self.file, id), Channel { topic, namespace, content, messages: 0 });
    }

    /// Adds a message of a channel.
    fn message(&mut self, file: &Path, channel: u16, time: u64, data: &[u8]) -> Result<(), LogError> {
        let Some(channel) = self.channels.get_mut(&(self.file, channel)) else { return Ok(()) };
        channel.messages += 1;
        if channel.content == Content::Other {
            return Ok(());
        }
        let (topic, message) = (channel.topic.clone(), channel.messages);
        let refused = |cause| LogError::McapMessage { file: file.into(), topic, message, cause };
        if channel.content == Content::Part {
            let part = serde_json::from_slice(data);
            self.parts.push((time, part.map_err(|cause| LogError::MetaSyntax { file: file.into(), cause })?));
            return Ok(());
        }
        let content = channel.content;
        let robot = self.robots.entry(channel.namespace.clone()).or_default();
        match content {
            Content::State => {
                let state: twinstep_unitree::LowState = decode(data).map_err(refused)?;
                robot.states.push((time, state.into()));
            }
            Content::Command => {
                let command: twinstep_unitree::LowCmd = decode(data).map_err(refused)?;
                robot.commands.push((time, command.into()));
            }
            _ => {
                let state: twinstep_unitree::SportModeState = decode(data).map_err(refused)?;
                robot.base_clock.push(u64::from(state.sec.unsigned_abs()) * 1_000_000_000 + u64::from(state.nanosec));
                robot.base_states.push((time, BaseState { position: state.position, velocity: state.velocity }));
            }
        }
        Ok(())
    }

    /// Takes the messages of the robot of which most is recorded, sorted by arrival. Returns the namespaces of the others too.
    pub fn take_robot(&mut self) -> (Messages, Vec<String>) {
        self.parts.sort_by_key(|(time, _)| *time);
        let mut robots: Vec<(String, Messages)> = std::mem::take(&mut self.robots).into_iter().collect();
        // A robot repeats its states at a lower rate, on /lf/lowstate.
        robots.sort_by_key(|(_, robot)| std::cmp::Reverse((!robot.commands.is_empty(), robot.states.len())));
        let others = robots.iter().skip(1).filter(|(_, robot)| !robot.states.is_empty());
        let others = others.map(|(namespace, _)| format!("/{namespace}")).collect();
        let mut robot = robots.into_iter().next().map(|(_, robot)| robot).unwrap_or_default();
        robot.order();
        (robot, others)
    }

    /// Returns the topics with the number of their messages as text, for errors.
    pub fn topics(&self) -> String {
        let topic = |channel: &Channel| format!("`{}` ({} messages)", channel.topic, channel.messages);
        let topics: Vec<_> = self.channels.values().map(topic).collect();
        if topics.is_empty() { "none".to_owned() } else { topics.join(", ") }
    }
}

impl Messages {
    /// Sorts all messages by arrival, and gives base states the times of their sender.
    fn order(&mut self) {
        let arrivals: Vec<u64> = self.base_states.iter().map(|(time, _)| *time).collect();
        let times = sender_times(&arrivals, &self.base_clock).times;
        let states = std::mem::take(&mut self.base_states).into_iter().zip(times);
        self.base_states = states.filter_map(|((_, state), time)| Some((time?, state))).collect();
        self.base_states.sort_by_key(|(time, _)| *time);
        self.states.sort_by_key(|(time, _)| *time);
        self.commands.sort_by_key(|(time, _)| *time);
    }
}

/// Returns the namespace of a topic, its content, and the name of its messages.
///
/// Topics of DDS have `rt/` in front: `rt/lowstate` is `/lowstate`.
fn kind(topic: &str) -> (String, Content, &'static str) {
    if topic == PART_TOPIC {
        return (String::new(), Content::Part, "");
    }
    let path = topic.trim_start_matches('/');
    let (namespace, name) = path.rsplit_once('/').unwrap_or(("", path));
    let (content, message) = match name {
        "lowstate" => (Content::State, "LowState"),
        "lowcmd" => (Content::Command, "LowCmd"),
        "sportmodestate" => (Content::BaseState, "SportModeState"),
        _ => (Content::Other, ""),
    };
    let namespace = namespace.strip_prefix("rt").map_or(namespace, |rest| rest.trim_start_matches('/'));
    (namespace.to_owned(), content, message)
}

fn read_metadata(file: &Path, metadata: &Metadata) -> Result<(Meta, Vec<String>), LogError> {
    let wrong = |cause| LogError::MetaSyntax { file: file.into(), cause };
    let text = |key: &str| metadata.metadata.get(key).map_or("", String::as_str);
    let meta: Meta = serde_json::from_str(text("meta")).map_err(wrong)?;
    meta.check(file)?;
    Ok((meta, serde_json::from_str(text("columns")).map_err(wrong)?))
}
