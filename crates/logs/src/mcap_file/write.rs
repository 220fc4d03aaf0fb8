//! Writes a log to an MCAP file.

use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::path::Path;

use mcap::McapError;
use mcap::records::{MessageHeader, Metadata};
use twinstep_model::{Joint, Leg};
use twinstep_unitree::{
    HEAD, ImuState, LOW_LEVEL, LowCmd, LowState, MotorCmd, MotorState, SERVO, encode, foot_index, motor_index,
};

use super::{METADATA, NANOSECONDS, NO_FORCE, NO_TEMPERATURE, PART_TOPIC, SegmentStart};
use crate::{CellLocation, Log, LogError};

/// Quantities that are in neither message.
const NOT_IN_MESSAGES: [&str; 3] = ["pos", "vel", "contact"];

/// Topic, name and definition of the robot's messages.
pub(super) const SCHEMAS: [(&str, &str, &[u8]); 2] = [
    ("/lowstate", "unitree_go/msg/LowState", include_bytes!("schema/LowState.msg")),
    ("/lowcmd", "unitree_go/msg/LowCmd", include_bytes!("schema/LowCmd.msg")),
];

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
    check_gains(log, file)?;
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
    let mut writer = mcap::WriteOptions::new().profile("ros2").library("twinstep").create(target)?;
    let none = BTreeMap::new();
    let mut channel = |(topic, name, schema): (&str, &str, &[u8])| {
        let schema = writer.add_schema(name, "ros2msg", schema)?;
        writer.add_channel(schema, topic, "cdr", &none)
    };
    let (states, commands) = (channel(SCHEMAS[0])?, channel(SCHEMAS[1])?);
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
            send(states, &encode(&state(log, joints, row)))?;
            send(commands, &encode(&command(log, joints, row)))?;
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
    let imu_state = ImuState {
        quaternion: ["w", "x", "y", "z"].map(|part| number(&format!("quat_{part}"))),
        gyroscope: axes("gyro"),
        accelerometer: axes("acc"),
        ..ImuState::default()
    };
    let mut state =
        LowState { head: HEAD, level_flag: LOW_LEVEL, imu_state, power_v: number("battery_V"), ..LowState::default() };
    for leg in Leg::ALL {
        let force = cell(log, &format!("foot_force_{}", leg.name()), row, 0.0);
        state.foot_force[foot_index(leg)] = if force.is_nan() { NO_FORCE } else { force.round() as i16 };
    }
    for joint in joints {
        let temperature = cell(log, &format!("temp_{joint}"), row, 0.0);
        state.motor_state[motor_index(*joint)] = MotorState {
            mode: SERVO,
            q: number(&format!("q_{joint}")),
            dq: number(&format!("dq_{joint}")),
            tau_est: number(&format!("tau_measured_{joint}")),
            temperature: if temperature.is_nan() { NO_TEMPERATURE } else { temperature.round() as u8 },
            ..MotorState::default()
        };
    }
    state
}

fn command(log: &Log, joints: &[Joint], row: usize) -> LowCmd {
    // The checksum is zero, so that a robot ignores commands replayed from a log.
    let mut command = LowCmd { head: HEAD, level_flag: LOW_LEVEL, ..LowCmd::default() };
    for joint in joints {
        let number = |quantity: &str| cell(log, &format!("{quantity}_{joint}"), row, 0.0) as f32;
        command.motor_cmd[motor_index(*joint)] = MotorCmd {
            mode: SERVO,
            q: number("q_cmd"),
            dq: number("dq_cmd"),
            tau: number("tau_ff"),
            kp: log.kp(joint.name(), row).unwrap_or(0.0) as f32,
            kd: log.kd(joint.name(), row).unwrap_or(0.0) as f32,
            ..MotorCmd::default()
        };
    }
    command
}

/// Checks that the gains of a measured log are known, because every command has gains.
fn check_gains(log: &Log, file: &Path) -> Result<(), LogError> {
    let unknown =
        |joint: &&String| log.q(joint).is_some() && (log.kp(joint, 0).is_none() || log.kd(joint, 0).is_none());
    match log.joints().iter().find(unknown) {
        Some(joint) => Err(LogError::GainsNotInMcap { file: file.into(), joint: joint.clone() }),
        None => Ok(()),
    }
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
