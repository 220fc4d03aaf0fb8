//! Logs as MCAP: reading and writing the robot's `/lowstate` and `/lowcmd`, one row per state.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, Write};
use std::path::Path;

use mcap::McapError;
use mcap::records::{MessageHeader, Metadata, Record};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::{Deserialize, Serialize};
use twinstep_model::{BaseMount, Joint, Leg};

use crate::cdr;
use crate::go2_message::{LowCmd, LowState, MotorCmd, MotorState, NO_POSITION, NO_VELOCITY, SERVO, foot, motor};
use crate::table::Table;
use crate::{CellLocation, Log, LogError, Meta, Segment, TorqueSensor};

/// Topic with the start of each segment of each episode, in files that `Log::write` wrote.
const PART_TOPIC: &str = "/twinstep/part";
/// Name of the MCAP metadata record with `meta` and `columns` as JSON, in files that `Log::write` wrote.
const METADATA: &str = "twinstep_log";
/// Limit of the length of chunks and records; longer ones are treated as damage [bytes].
const LENGTH_LIMIT: usize = 1 << 30;
/// Value of a missing foot force, which no sensor reports.
const NO_FORCE: i16 = i16::MIN;
/// Value of a missing temperature, which no sensor reports.
const NO_TEMPERATURE: u8 = u8::MAX;
/// Quantities that are in neither message.
const NOT_IN_MESSAGES: [&str; 3] = ["pos", "vel", "contact"];

const NANOSECONDS: f64 = 1e9;

/// Start of a segment of an episode.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct SegmentStart {
    segment: u32,
    episode: u32,
    /// Time of the first row in the log [s].
    t: f64,
}

/// Content of an MCAP file that belongs to a log.
#[derive(Default)]
struct Recording {
    states: Vec<(u64, LowState)>,
    commands: Vec<(u64, LowCmd)>,
    parts: Vec<(u64, SegmentStart)>,
    /// Metadata and column names, in a file that `Log::write` wrote.
    own_meta: Option<(Meta, Vec<String>)>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
    /// True if the file ends before its last record.
    truncated: bool,
}

/// Channel of the file, with the number of its messages.
struct Channel {
    topic: String,
    content: Content,
    messages: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Content {
    State,
    Command,
    Part,
    Other,
}

/// Reads a log and its metadata: those in the file, else those of the metadata file, else default metadata.
pub(crate) fn read(file: &Path, meta_file: Option<Meta>) -> Result<(Table, Meta), LogError> {
    let mut recording = Recording::read(file)?;
    recording.order();
    if recording.states.is_empty() || recording.commands.is_empty() {
        let expected = if recording.states.is_empty() { "/lowstate" } else { "/lowcmd" };
        return Err(LogError::McapTopic { file: file.into(), expected, topics: recording.topics() });
    }
    let own_meta = recording.own_meta.take();
    let columns = own_meta.as_ref().map(|(_, columns)| columns.as_slice());
    let (table, rate_hz) = recording.table(file, columns)?;
    let meta = match (own_meta, meta_file) {
        (Some((meta, _)), _) | (None, Some(meta)) => meta,
        (None, None) => default_meta(&table, rate_hz),
    };
    Ok((table, meta))
}

/// Returns the default metadata of a recording.
fn default_meta(table: &Table, rate_hz: f64) -> Meta {
    let whole = rate_hz.round();
    let rate_hz = if (rate_hz / whole - 1.0).abs() < 0.02 { whole } else { rate_hz };
    let torque = table.columns.iter().any(|(name, _)| name.starts_with("tau_measured_"));
    let tau_sensor = if torque { TorqueSensor::MotorCurrent } else { TorqueSensor::None };
    let segment = Segment { name: "recording".to_owned(), base: BaseMount::Floating };
    Meta {
        source: Some("unitree_go LowState and LowCmd in MCAP".to_owned()),
        ..Meta::new(rate_hz, tau_sensor, vec![segment])
    }
}

impl Recording {
    fn read(file: &Path) -> Result<Recording, LogError> {
        let refused = |cause| LogError::Read { file: file.into(), cause };
        let damaged = |cause| LogError::Mcap { file: file.into(), cause };
        let mut source = BufReader::new(File::open(file).map_err(refused)?);
        let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
        let mut reader = LinearReader::new_with_options(options.with_record_length_limit(LENGTH_LIMIT));
        let mut recording = Recording::default();
        while let Some(event) = reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(bytes)) => {
                    let got = source.read(reader.insert(bytes)).map_err(refused)?;
                    reader.notify_read(got);
                }
                Ok(LinearReadEvent::Record { data, opcode }) => {
                    recording.add(file, mcap::parse_record(opcode, data).map_err(damaged)?)?;
                }
                // A recorder that lost power wrote complete chunks up to that time.
                Err(McapError::UnexpectedEof) if !recording.states.is_empty() => {
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
            Content::State => self.states.push((time, cdr::decode(data).map_err(refused)?)),
            Content::Command => self.commands.push((time, cdr::decode(data).map_err(refused)?)),
            Content::Part => {
                let part = serde_json::from_slice(data);
                self.parts.push((time, part.map_err(|cause| LogError::MetaSyntax { file: file.into(), cause })?));
            }
            Content::Other => {}
        }
        Ok(())
    }

    /// Sorts states, commands and parts by time.
    fn order(&mut self) {
        self.states.sort_by_key(|(time, _)| *time);
        self.commands.sort_by_key(|(time, _)| *time);
        self.parts.sort_by_key(|(time, _)| *time);
    }

    /// Returns the topics with the number of their messages as text, for errors.
    fn topics(&self) -> String {
        let topic = |channel: &Channel| format!("`{}` ({} messages)", channel.topic, channel.messages);
        let topics: Vec<_> = self.channels.values().map(topic).collect();
        if topics.is_empty() { "none".to_owned() } else { topics.join(", ") }
    }

    /// Returns the columns of all rows, and the rate of the states [Hz].
    ///
    /// `written` are the column names in a file that `Log::write` wrote.
    fn table(mut self, file: &Path, written: Option<&[String]>) -> Result<(Table, f64), LogError> {
        let mut notes = Vec::new();
        if self.truncated {
            let rows = self.states.len();
            notes.push(format!("the MCAP file is truncated: read the {rows} states of its complete chunks"));
        }
        let states = self.states.len();
        // Times must increase: of several states with the same time, the last is used.
        self.states.dedup_by(|later, earlier| {
            let same = later.0 == earlier.0;
            if same {
                std::mem::swap(later, earlier);
            }
            same
        });
        note_count(&mut notes, states - self.states.len(), "with the same time as a later one");
        let median = median_step(&self.states);
        let in_force = self.commands_in_force(median);
        let start = in_force.iter().position(Option::is_some).unwrap_or(self.states.len());
        if start == self.states.len() {
            return Err(LogError::McapTopic {
                file: file.into(),
                expected: "/lowcmd before the last /lowstate",
                topics: self.topics(),
            });
        }
        note_count(&mut notes, start, "before the first command");
        let mut rows: Vec<StateWithCommand> = (start..self.states.len())
            .filter_map(|row| {
                Some(StateWithCommand {
                    time: self.states[row].0,
                    state: &self.states[row].1,
                    command: self.commands[in_force[row]?].1.clone(),
                })
            })
            .collect();
        let stopped = rows.iter_mut().map(StateWithCommand::normalise_stop_commands).sum::<usize>();
        if stopped > 0 {
            notes.push(format!(
                "{stopped} motor commands that stop the motor or have no position are read with gains of 0"
            ));
        }
        if written.is_none() && rows.iter().any(|row| row.state.foot_force != [0; 4]) {
            notes.push(
                "foot_force is the robot's raw count, not newtons: it only distinguishes loaded from unloaded feet"
                    .to_owned(),
            );
        }
        let columns = columns(&rows, &self.parts, written);
        let ignored = self.channels.values().filter(|channel| channel.content == Content::Other);
        let ignored =
            ignored.map(|channel| format!("topic {} ({} messages)", channel.topic, channel.messages)).collect();
        Ok((
            Table { file: file.into(), columns, ignored, lines: Vec::new(), notes },
            if median == 0 { 1.0 } else { NANOSECONDS / median as f64 },
        ))
    }

    /// Returns for each state the index of the command in force midway between it and the next state.
    ///
    /// A controller's command arrives shortly after the state that it responds to, and is in force for most of the
    /// interval.
    fn commands_in_force(&self, median: u64) -> Vec<Option<usize>> {
        let mut next = 0;
        let in_force = |(row, (time, _)): (usize, &(u64, LowState))| {
            let step = self.states.get(row + 1).map_or(median, |(later, _)| later - time);
            let middle = time + step.min(median) / 2;
            while self.commands.get(next).is_some_and(|(time, _)| *time <= middle) {
                next += 1;
            }
            next.checked_sub(1)
        };
        self.states.iter().enumerate().map(in_force).collect()
    }
}

fn note_count(notes: &mut Vec<String>, count: usize, what: &str) {
    match count {
        0 => {}
        1 => notes.push(format!("omitted one state {what}")),
        _ => notes.push(format!("omitted {count} states {what}")),
    }
}

/// Returns the median time between states [ns]; zero for a single state.
fn median_step(states: &[(u64, LowState)]) -> u64 {
    let mut steps: Vec<u64> = states.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    steps.sort_unstable();
    steps.get(steps.len() / 2).copied().unwrap_or(0)
}

/// State with the command in force from it to the next state.
struct StateWithCommand<'a> {
    time: u64,
    state: &'a LowState,
    command: LowCmd,
}

impl StateWithCommand<'_> {
    /// Replaces the robot's special values (no position, no velocity, stopped motor) by gains of 0.
    ///
    /// Returns the number of motor commands without a position or with a stopped motor.
    fn normalise_stop_commands(&mut self) -> usize {
        let mut stops = 0;
        for (command, state) in self.command.motors.iter_mut().zip(&self.state.motors) {
            if command.mode == 0 {
                *command = MotorCmd { mode: 0, q: state.q, ..MotorCmd::default() };
                stops += 1;
            }
            if command.q >= NO_POSITION {
                (command.q, command.kp) = (state.q, 0.0);
                stops += 1;
            }
            if command.dq == NO_VELOCITY {
                (command.dq, command.kd) = (0.0, 0.0);
            }
        }
        stops
    }
}

/// Function that returns a value of a motor.
type OfMotor = fn(&MotorState, &MotorCmd) -> f32;

/// Returns all columns: those in `written`, or else those that are not zero throughout.
fn columns(
    rows: &[StateWithCommand<'_>],
    parts: &[(u64, SegmentStart)],
    written: Option<&[String]>,
) -> Vec<(String, Vec<f64>)> {
    let had = |name: &str| written.is_none_or(|written| written.iter().any(|column| column == name));
    let column =
        |of: &dyn Fn(&StateWithCommand<'_>) -> f32| rows.iter().map(|row| f64::from(of(row))).collect::<Vec<_>>();
    let joints: Vec<Joint> = Joint::ALL.into_iter().filter(|joint| had(&format!("q_cmd_{joint}"))).collect();
    let mut columns = time_columns(rows, parts);

    let of_motors = |of: OfMotor| {
        let of_joint =
            |joint: &Joint| column(&|row| of(&row.state.motors[motor(*joint)], &row.command.motors[motor(*joint)]));
        joints.iter().map(of_joint).collect::<Vec<_>>()
    };
    let gains: [(&str, OfMotor); 2] = [("kp", |_, command| command.kp), ("kd", |_, command| command.kd)];
    for (name, of) in gains {
        let cells = of_motors(of);
        if written.map_or_else(|| cells.windows(2).all(|pair| pair[0] == pair[1]), |_| had(name)) {
            columns.extend(cells.into_iter().next().map(|cells| (name.to_owned(), cells)));
        } else {
            columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(cells));
        }
    }
    let commands: [(&str, OfMotor); 3] =
        [("q_cmd", |_, command| command.q), ("dq_cmd", |_, command| command.dq), ("tau_ff", |_, command| command.tau)];
    let sensors: [(&str, OfMotor); 4] = [
        ("q", |state, _| state.q),
        ("dq", |state, _| state.dq),
        ("tau_measured", |state, _| state.tau_est),
        ("temp", |state, _| if state.temperature == NO_TEMPERATURE { f32::NAN } else { f32::from(state.temperature) }),
    ];
    let zero = |cells: &[Vec<f64>]| cells.iter().flatten().all(|cell| *cell == 0.0);
    for (name, of) in commands {
        columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(of_motors(of)));
    }
    for (name, of) in sensors {
        let cells = of_motors(of);
        if written.is_some() || name == "q" || !zero(&cells) {
            columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(cells));
        }
    }
    let mut of_robot = |quantity: &str, names: &[&str], cells: Vec<Vec<f64>>| {
        if written.is_some() || !zero(&cells) {
            columns.extend(names.iter().map(|name| format!("{quantity}{name}")).zip(cells));
        }
    };
    of_robot("gyro", &["_x", "_y", "_z"], (0..3).map(|axis| column(&|row| row.state.gyroscope[axis])).collect());
    of_robot("acc", &["_x", "_y", "_z"], (0..3).map(|axis| column(&|row| row.state.accelerometer[axis])).collect());
    of_robot("quat", &["_w", "_x", "_y", "_z"], (0..4).map(|part| column(&|row| row.state.quaternion[part])).collect());
    let force = |leg: Leg| {
        column(&|row| match row.state.foot_force[foot(leg)] {
            NO_FORCE => f32::NAN,
            force => f32::from(force),
        })
    };
    of_robot(
        "foot_force",
        &Leg::ALL.map(|leg| ["_FL", "_FR", "_RL", "_RR"][leg as usize]),
        Leg::ALL.map(force).to_vec(),
    );
    of_robot("battery_V", &[""], vec![column(&|row| row.state.power_v)]);
    columns.retain(|(name, _)| matches!(name.as_str(), "t" | "segment" | "episode") || had(name));
    columns
}

/// Returns the column `t`, and `segment` and `episode` if the file has the starts of segments.
fn time_columns(rows: &[StateWithCommand<'_>], parts: &[(u64, SegmentStart)]) -> Vec<(String, Vec<f64>)> {
    let first = rows.first().map_or(0, |row| row.time);
    let whole = (first, SegmentStart { segment: 0, episode: 0, t: 0.0 });
    let mut at = 0;
    let (mut t, mut segment, mut episode) = (Vec::new(), Vec::new(), Vec::new());
    for row in rows {
        while parts.get(at).is_some_and(|(time, _)| *time <= row.time) {
            at += 1;
        }
        let (start, part) = if at == 0 { whole } else { parts[at - 1] };
        t.push(part.t + (row.time - start) as f64 / NANOSECONDS);
        segment.push(f64::from(part.segment));
        episode.push(f64::from(part.episode));
    }
    let mut columns = vec![("t".to_owned(), t)];
    if !parts.is_empty() {
        columns.extend([("segment".to_owned(), segment), ("episode".to_owned(), episode)]);
    }
    columns
}

fn read_metadata(file: &Path, metadata: &Metadata) -> Result<(Meta, Vec<String>), LogError> {
    let wrong = |cause| LogError::MetaSyntax { file: file.into(), cause };
    let text = |key: &str| metadata.metadata.get(key).map_or("", String::as_str);
    let meta: Meta = serde_json::from_str(text("meta")).map_err(wrong)?;
    meta.check(file)?;
    Ok((meta, serde_json::from_str(text("columns")).map_err(wrong)?))
}

/// Returns the columns of a log that MCAP does not support.
pub(crate) fn unsupported_columns(log: &Log) -> Vec<String> {
    let outside = |name: &str| {
        crate::columns::Column::parse(name).is_some_and(|column| NOT_IN_MESSAGES.contains(&column.quantity.name))
    };
    log.channels().map(|(name, _)| name).filter(|name| outside(name)).map(str::to_owned).collect()
}

/// Writes a log as the robot's messages, compressed with Zstandard. Errors contain `file`.
pub(crate) fn write(log: &Log, file: &Path, target: impl Write + Seek) -> Result<(), LogError> {
    let joints: Vec<Joint> = (log.joints().iter())
        .map(|name| name.parse().map_err(|_| LogError::NotAGo2Joint { file: file.into(), joint: name.clone() }))
        .collect::<Result<_, _>>()?;
    check_range(log, file)?;
    let unsupported = unsupported_columns(log);
    let columns: Vec<&str> =
        log.channels().map(|(name, _)| name).filter(|name| !unsupported.iter().any(|other| other == name)).collect();
    let json = |cause| LogError::MetaSyntax { file: file.into(), cause };
    let metadata = BTreeMap::from([
        ("meta".to_owned(), serde_json::to_string(log.meta()).map_err(json)?),
        ("columns".to_owned(), serde_json::to_string(&columns).map_err(json)?),
    ]);
    write_messages(log, &joints, metadata, target).map_err(|cause| LogError::Mcap { file: file.into(), cause })
}

fn write_messages(
    log: &Log,
    joints: &[Joint],
    metadata: BTreeMap<String, String>,
    target: impl Write + Seek,
) -> Result<(), McapError> {
    const MESSAGES: [(&str, &str, &[u8]); 2] = [
        ("/lowstate", "unitree_go/msg/LowState", include_bytes!("schema/LowState.msg")),
        ("/lowcmd", "unitree_go/msg/LowCmd", include_bytes!("schema/LowCmd.msg")),
    ];
    let mut writer = mcap::WriteOptions::new().profile("ros2").library("twinstep").create(target)?;
    let none = BTreeMap::new();
    let mut channel = |(topic, name, schema): (&str, &str, &[u8])| {
        let schema = writer.add_schema(name, "ros2msg", schema)?;
        writer.add_channel(schema, topic, "cdr", &none)
    };
    let (states, commands) = (channel(MESSAGES[0])?, channel(MESSAGES[1])?);
    let parts = writer.add_channel(0, PART_TOPIC, "json", &none)?;
    writer.write_metadata(&Metadata { name: METADATA.to_owned(), metadata })?;
    let pause = (NANOSECONDS / log.meta().rate_hz) as u64 + 1;
    let mut start = 0;
    for (_, rows) in log.segments() {
        let mut time = start;
        for row in rows.clone() {
            time = start + ((log.t()[row] - log.t()[rows.start]) * NANOSECONDS).round() as u64;
            let mut send = |channel_id, data: &[u8]| {
                let header = MessageHeader { channel_id, sequence: row as u32, log_time: time, publish_time: time };
                writer.write_to_known_channel(&header, data)
            };
            if row == rows.start {
                let part = SegmentStart { segment: log.segment()[row], episode: log.episode()[row], t: log.t()[row] };
                send(parts, serde_json::to_string(&part).unwrap_or_default().as_bytes())?;
            }
            send(states, &cdr::encode(&mut state(log, joints, row)))?;
            send(commands, &cdr::encode(&mut command(log, joints, row)))?;
        }
        start = time + pause;
    }
    writer.finish().map(drop)
}

/// Returns a cell of a column, or `missing` if the log does not have the column.
fn cell(log: &Log, name: &str, row: usize, missing: f64) -> f64 {
    log.channel(name).map_or(missing, |cells| cells[row])
}

fn state(log: &Log, joints: &[Joint], row: usize) -> LowState {
    let number = |name: &str| cell(log, name, row, 0.0) as f32;
    let axes = |quantity: &str| ["x", "y", "z"].map(|axis| number(&format!("{quantity}_{axis}")));
    let mut state = LowState {
        quaternion: ["w", "x", "y", "z"].map(|part| number(&format!("quat_{part}"))),
        gyroscope: axes("gyro"),
        accelerometer: axes("acc"),
        power_v: number("battery_V"),
        ..LowState::default()
    };
    for leg in Leg::ALL {
        let force = cell(log, &format!("foot_force_{}", leg.name()), row, 0.0);
        state.foot_force[foot(leg)] = if force.is_nan() { NO_FORCE } else { force.round() as i16 };
    }
    for joint in joints {
        let temperature = cell(log, &format!("temp_{joint}"), row, 0.0);
        state.motors[motor(*joint)] = MotorState {
            mode: SERVO,
            q: number(&format!("q_{joint}")),
            dq: number(&format!("dq_{joint}")),
            tau_est: number(&format!("tau_measured_{joint}")),
            temperature: if temperature.is_nan() { NO_TEMPERATURE } else { temperature.round() as u8 },
        };
    }
    state
}

fn command(log: &Log, joints: &[Joint], row: usize) -> LowCmd {
    let mut command = LowCmd::default();
    for joint in joints {
        let number = |quantity: &str| cell(log, &format!("{quantity}_{joint}"), row, 0.0) as f32;
        command.motors[motor(*joint)] = MotorCmd {
            mode: SERVO,
            q: number("q_cmd"),
            dq: number("dq_cmd"),
            tau: number("tau_ff"),
            kp: log.kp(joint.name(), row).unwrap_or(0.0) as f32,
            kd: log.kd(joint.name(), row).unwrap_or(0.0) as f32,
        };
    }
    command
}

/// Checks that every cell is in the range of its field of the message.
fn check_range(log: &Log, file: &Path) -> Result<(), LogError> {
    const SINGLE: f64 = f32::MAX as f64;
    for (column, cells) in log.channels() {
        let (low, high, range) = match column {
            _ if column.starts_with("temp_") => (0.0, f64::from(NO_TEMPERATURE - 1), "0 to 254 °C"),
            _ if column.starts_with("foot_force_") => (f64::from(NO_FORCE + 1), f64::from(i16::MAX), "-32767 to 32767"),
            // Larger values disable the position loop.
            _ if column.starts_with("q_cmd_") => (-SINGLE, 2e9, "positions up to 2e9 rad"),
            _ => (-SINGLE, SINGLE, "numbers up to 3.4e38"),
        };
        if let Some(row) = cells.iter().position(|cell| *cell < low || *cell > high) {
            let place = CellLocation { file: file.into(), column: column.to_owned(), row: row + 1, line: None };
            return Err(LogError::NotInMcap { place, value: cells[row], range });
        }
    }
    Ok(())
}
