//! Reads a log from an MCAP file.

use std::path::{Path, PathBuf};

use twinstep_model::BaseMount;

use super::base_state::base_columns;
use super::clock::{SendTimes, periodic_times, sender_times};
use super::columns::columns;
use super::messages::{Content, Messages, Recording};
use super::rows::{StateWithCommand, commands_in_force, median_step};
use super::{NANOSECONDS, SegmentStart};
use crate::go2_message::LowState;
use crate::table::Table;
use crate::{LogError, Meta, Segment, TorqueSensor};

/// Reads a log and its metadata: those in the files, else those of the metadata file, else default metadata; and whether `Log::write`
/// wrote the files.
///
/// `files` are the parts of one recording; errors name the first. A recording without commands is read if `has_commands` is false.
pub(crate) fn read(
    files: &[PathBuf],
    meta_file: Option<Meta>,
    has_commands: bool,
) -> Result<(Table, Meta, bool), LogError> {
    let file = &files[0];
    let mut recording = Recording::read(files)?;
    let (robot, others) = recording.take_robot();
    if robot.states.is_empty() || (has_commands && robot.commands.is_empty()) {
        let expected = if robot.states.is_empty() { "/lowstate" } else { "/lowcmd" };
        return Err(LogError::McapTopic { file: file.into(), expected, topics: recording.topics() });
    }
    let own_meta = recording.own_meta.take();
    let columns = own_meta.as_ref().map(|(_, columns)| columns.as_slice());
    let (mut table, rate_hz) = table(&recording, robot, file, (columns, has_commands))?;
    if !others.is_empty() {
        table.notes.push(format!("the states of other robots are left out: topics in {}", others.join(", ")));
    }
    let is_written = own_meta.is_some();
    let meta = match (own_meta, meta_file) {
        (Some((meta, _)), _) | (None, Some(meta)) => meta,
        (None, None) => default_meta(&table, rate_hz),
    };
    Ok((table, meta, is_written))
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
fn table(
    recording: &Recording,
    robot: Messages,
    file: &Path,
    (written, has_commands): (Option<&[String]>, bool),
) -> Result<(Table, f64), LogError> {
    let mut notes = Vec::new();
    if recording.truncated {
        let rows = robot.states.len();
        notes.push(format!("the MCAP file is truncated: read the {rows} states of its complete chunks"));
    }
    let Messages { states, commands, base_states, .. } = robot;
    let (states, times, mut parts) = timed_states(states, written.is_some(), &mut notes);
    if parts.is_empty() {
        parts.clone_from(&recording.parts);
    }
    let arrivals: Vec<u64> = commands.iter().map(|(time, _)| *time).collect();
    let command_times = if written.is_some() { arrivals } else { periodic_times(&arrivals) };
    let median = median_step(times.iter().copied());
    let in_force = commands_in_force(&times, &command_times, median);
    let start = if has_commands { in_force.iter().position(Option::is_some).unwrap_or(states.len()) } else { 0 };
    if start == states.len() {
        return Err(LogError::McapTopic {
            file: file.into(),
            expected: "/lowcmd before the last /lowstate",
            topics: recording.topics(),
        });
    }
    note_count(&mut notes, start, "before the first command");
    let command = |row: usize| in_force[row].map(|index| commands[index].1.clone()).unwrap_or_default();
    let mut rows: Vec<StateWithCommand> = (start..states.len())
        .map(|row| StateWithCommand { time: times[row], state: &states[row], command: command(row) })
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
    let mut columns = columns(&rows, &parts, written);
    if !has_commands {
        let of_command =
            |name: &str| ["kp", "kd", "q_cmd", "dq_cmd", "tau_ff"].iter().any(|quantity| name.starts_with(quantity));
        columns.retain(|(name, _)| !of_command(name));
    }
    columns.extend(base_columns(&times[start..], &base_states));
    let ignored = recording.channels.values().filter(|channel| channel.content == Content::Other);
    let ignored = ignored.map(|channel| format!("topic {} ({} messages)", channel.topic, channel.messages)).collect();
    Ok((
        Table { file: file.into(), columns, ignored, lines: Vec::new(), notes },
        if median == 0 { 1.0 } else { NANOSECONDS / median as f64 },
    ))
}

/// Returns the states with their times by the robot's clock, and where it started again, as episodes.
///
/// A file that `Log::write` wrote has the times of its rows as arrivals.
#[allow(clippy::type_complexity, reason = "the three parts of one result")]
fn timed_states(
    states: Vec<(u64, LowState)>,
    is_own: bool,
    notes: &mut Vec<String>,
) -> (Vec<LowState>, Vec<u64>, Vec<(u64, SegmentStart)>) {
    let arrivals: Vec<u64> = states.iter().map(|(time, _)| *time).collect();
    let clock: Vec<u64> = states.iter().map(|(_, state)| u64::from(state.tick) * 1_000_000).collect();
    let SendTimes { times, restarts, is_by_clock } =
        if is_own { SendTimes::of_arrivals(&arrivals) } else { sender_times(&arrivals, &clock) };
    let unusable = times.iter().filter(|time| time.is_none()).count();
    note_count(notes, unusable, "whose `tick` repeats or jumps");
    if !is_own && !is_by_clock {
        notes.push("the robot's clock (`tick`) does not run: rows have the times of arrival".to_owned());
    }
    let (mut kept, mut kept_times, mut parts, mut same) = (Vec::new(), Vec::<u64>::new(), Vec::new(), 0);
    let first = times.iter().flatten().next().copied().unwrap_or(0);
    for (index, ((_, state), time)) in states.into_iter().zip(times).enumerate() {
        let Some(time) = time else { continue };
        if let Some(restart) = restarts.iter().position(|start| *start == index) {
            let t = time.saturating_sub(first) as f64 / NANOSECONDS;
            parts.push((time, SegmentStart { segment: 0, episode: restart as u32 + 1, t }));
        }
        match kept_times.last().copied() {
            // Times must increase: of several states with the same time, the last is used.
            Some(last) if time <= last => {
                same += 1;
                if let Some(place) = kept.last_mut() {
                    *place = state;
                }
            }
            _ => {
                kept.push(state);
                kept_times.push(time);
            }
        }
    }
    note_count(notes, same, "with the same time as a later one");
    if !parts.is_empty() {
        notes.push(format!("the robot restarted {} times: each start begins an episode", parts.len()));
        parts.insert(0, (first, SegmentStart { segment: 0, episode: 0, t: 0.0 }));
    }
    (kept, kept_times, parts)
}

fn note_count(notes: &mut Vec<String>, count: usize, what: &str) {
    match count {
        0 => {}
        1 => notes.push(format!("omitted one state {what}")),
        _ => notes.push(format!("omitted {count} states {what}")),
    }
}
