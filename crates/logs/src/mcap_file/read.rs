//! Reads a log from an MCAP file.

use std::path::Path;

use twinstep_model::BaseMount;

use super::NANOSECONDS;
use super::base_state::base_columns;
use super::clock::sender_times;
use super::columns::columns;
use super::messages::{Content, Recording};
use super::rows::{StateWithCommand, commands_in_force, median_step};
use crate::table::Table;
use crate::{LogError, Meta, Segment, TorqueSensor};

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
    let (table, rate_hz) = table(recording, file, columns)?;
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

/// Returns the columns of all rows, and the rate of the states [Hz].
///
/// `written` are the column names in a file that `Log::write` wrote.
fn table(mut recording: Recording, file: &Path, written: Option<&[String]>) -> Result<(Table, f64), LogError> {
    let mut notes = Vec::new();
    if recording.truncated {
        let rows = recording.states.len();
        notes.push(format!("the MCAP file is truncated: read the {rows} states of its complete chunks"));
    }
    let states = recording.states.len();
    // Times must increase: of several states with the same time, the last is used.
    recording.states.dedup_by(|later, earlier| {
        let same = later.0 == earlier.0;
        if same {
            std::mem::swap(later, earlier);
        }
        same
    });
    note_count(&mut notes, states - recording.states.len(), "with the same time as a later one");
    let arrivals = recording.states.iter().map(|(time, _)| *time);
    let in_force = commands_in_force(&recording.states, &recording.commands, median_step(arrivals));
    let start = in_force.iter().position(Option::is_some).unwrap_or(recording.states.len());
    if start == recording.states.len() {
        return Err(LogError::McapTopic {
            file: file.into(),
            expected: "/lowcmd before the last /lowstate",
            topics: recording.topics(),
        });
    }
    note_count(&mut notes, start, "before the first command");
    let times = state_times(&recording, written);
    let median = median_step(times.iter().copied());
    let mut rows: Vec<StateWithCommand> = (start..recording.states.len())
        .filter_map(|row| {
            Some(StateWithCommand {
                time: times[row],
                state: &recording.states[row].1,
                command: recording.commands[in_force[row]?].1.clone(),
            })
        })
        .collect();
    let stopped = rows.iter_mut().map(StateWithCommand::normalise_stop_commands).sum::<usize>();
    if stopped > 0 {
        notes
            .push(format!("{stopped} motor commands that stop the motor or have no position are read with gains of 0"));
    }
    if written.is_none() && rows.iter().any(|row| row.state.foot_force != [0; 4]) {
        notes.push(
            "foot_force is the robot's raw count, not newtons: it only distinguishes loaded from unloaded feet"
                .to_owned(),
        );
    }
    let mut columns = columns(&rows, &recording.parts, written);
    columns.extend(base_columns(&times[start..], &recording.base_states));
    let ignored = recording.channels.values().filter(|channel| channel.content == Content::Other);
    let ignored = ignored.map(|channel| format!("topic {} ({} messages)", channel.topic, channel.messages)).collect();
    Ok((
        Table { file: file.into(), columns, ignored, lines: Vec::new(), notes },
        if median == 0 { 1.0 } else { NANOSECONDS / median as f64 },
    ))
}

/// Returns the time of each state by the robot's clock, or its arrival in a file that `Log::write` wrote.
fn state_times(recording: &Recording, written: Option<&[String]>) -> Vec<u64> {
    let arrivals: Vec<u64> = recording.states.iter().map(|(time, _)| *time).collect();
    let clock = recording.states.iter().map(|(_, state)| u64::from(state.tick) * 1_000_000);
    if written.is_some() { arrivals } else { sender_times(&arrivals, &clock.collect::<Vec<_>>()) }
}

fn note_count(notes: &mut Vec<String>, count: usize, what: &str) {
    match count {
        0 => {}
        1 => notes.push(format!("omitted one state {what}")),
        _ => notes.push(format!("omitted {count} states {what}")),
    }
}
