//! Validation: creates a log from the columns of a file.

use std::collections::BTreeSet;
use std::path::Path;

use twinstep_model::JOINT_NAMES;

use crate::LogError;
use crate::columns::{Column, MissingCells};
use crate::log::{Log, contiguous_ranges};
use crate::meta::{Gain, Meta};
use crate::table::Table;

/// Kind of a log, which determines its required columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LogKind {
    /// Measured log: positions and commands.
    Measurement,
    /// Motion file: commands.
    Commands,
    /// Recording without commands.
    States,
}

/// Validates a table and its metadata, and creates a log from them.
pub(crate) fn assemble(mut table: Table, mut meta: Meta, meta_file: &Path, need: LogKind) -> Result<Log, LogError> {
    use_go2_joint_names(&mut table, &mut meta);
    check_joint_names(&table)?;
    let joints = joints_of(&table, &meta, need)?;
    ignore_other_joints(&mut table, &joints);
    require_columns(&table, &joints, need)?;
    check_lengths(&table)?;
    check_cells(&table)?;
    let rows = table.column("t").map_or(0, <[f64]>::len);
    let segment = take_index(&mut table, "segment", rows)?;
    let episode = take_index(&mut table, "episode", rows)?;
    check_segments(&table, &segment, &meta)?;
    check_time(&table, &segment, &episode)?;
    check_quaternion(&table)?;
    check_gains(&meta, meta_file, &joints)?;

    let t = table.take("t").unwrap_or_default();
    let channels = table.columns.into_iter().collect();
    Ok(Log {
        meta,
        t,
        segment,
        episode,
        joints,
        channels,
        ignored: table.ignored,
        notes: table.notes,
        measured_hz: None,
    })
}

/// Returns the joints in the metadata, or all with a position column (in a motion file: a command column).
fn joints_of(table: &Table, meta: &Meta, need: LogKind) -> Result<Vec<String>, LogError> {
    if !meta.joints.is_empty() {
        return Ok(meta.joints.clone());
    }
    let quantity = if need == LogKind::Commands { "q_cmd" } else { "q" };
    let joints: Vec<String> = (table.columns.iter())
        .filter_map(|(name, _)| Column::parse(name))
        .filter(|column| column.quantity.name == quantity)
        .filter_map(|column| column.joint().map(str::to_owned))
        .collect();
    if joints.is_empty() { Err(missing(table, &format!("{quantity}_<joint>"))) } else { Ok(joints) }
}

fn ignore_other_joints(table: &mut Table, joints: &[String]) {
    let joints: BTreeSet<&str> = joints.iter().map(String::as_str).collect();
    let other = |name: &str| Column::parse(name).and_then(|column| column.joint()).is_some_and(|j| !joints.contains(j));
    let (ignored, kept) = std::mem::take(&mut table.columns).into_iter().partition(|(name, _)| other(name));
    table.columns = kept;
    let ignored: Vec<(String, Vec<f64>)> = ignored;
    table.ignored.extend(ignored.into_iter().map(|(name, _)| name));
}

fn require_columns(table: &Table, joints: &[String], need: LogKind) -> Result<(), LogError> {
    if table.column("t").is_none() {
        return Err(missing(table, "t"));
    }
    let quantities: &[&str] = match need {
        LogKind::Measurement => &["q", "q_cmd"],
        LogKind::Commands => &["q_cmd"],
        LogKind::States => &["q"],
    };
    for joint in joints {
        for column in quantities.iter().map(|quantity| format!("{quantity}_{joint}")) {
            if table.column(&column).is_none() {
                return Err(LogError::MissingJointColumn { file: table.file.clone(), column, joint: joint.clone() });
            }
        }
    }
    Ok(())
}

fn missing(table: &Table, column: &str) -> LogError {
    // Names that other recorders use.
    let (what, others): (_, &[&str]) = match column {
        "t" => ("the time of each row [s]", &["time", "timestamp", "time_s", "t_s", "stamp", "sec", "seconds"]),
        "q_cmd_<joint>" => {
            ("a joint's commanded position, such as `q_cmd_FL_hip` [rad]", &["q_des_", "q_target_", "q_ref_"])
        }
        _ => ("a joint's measured position, such as `q_FL_hip` [rad]", &["pos_", "position_", "joint_pos_"]),
    };
    let names = table.columns.iter().map(|(name, _)| name).chain(&table.ignored);
    let meant = |name: &&String| {
        others
            .iter()
            .any(|other| if other.ends_with('_') { name.starts_with(other) } else { name.eq_ignore_ascii_case(other) })
    };
    let similar = names.into_iter().find(meant).cloned();
    LogError::MissingColumn {
        file: table.file.clone(),
        column: column.to_owned(),
        what,
        columns: table.names(),
        similar,
    }
}

/// Renames joints that have the name of the Go2's in its robot file, such as `FL_hip_joint`, or in another case.
fn use_go2_joint_names(table: &mut Table, meta: &mut Meta) {
    let known = |joint: &str| {
        let short = joint.strip_suffix("_joint").unwrap_or(joint);
        JOINT_NAMES.into_iter().find(|known| *known != joint && known.eq_ignore_ascii_case(short))
    };
    for joint in &mut meta.joints {
        if let Some(known) = known(joint) {
            known.clone_into(joint);
        }
    }
    let renamed = |name: &str| {
        let column = Column::parse(name)?;
        Some(format!("{}_{}", column.quantity.name, known(column.joint()?)?))
    };
    let mut example = None;
    for index in 0..table.columns.len() {
        let name = &table.columns[index].0;
        if let Some(new) = renamed(name).filter(|new| table.column(new).is_none()) {
            example.get_or_insert_with(|| {
                format!("joints are named as in the rest of twinstep: `{name}` is read as `{new}`")
            });
            table.columns[index].0 = new;
        }
    }
    table.notes.extend(example);
}

/// Fails if a joint's name is one of the Go2's with a suffix, such as a unit.
fn check_joint_names(table: &Table) -> Result<(), LogError> {
    for (name, _) in &table.columns {
        let Some((column, joint)) = Column::parse(name).and_then(|column| Some((column, column.joint()?))) else {
            continue;
        };
        let similar = |known: &&&str| {
            joint != **known && joint.get(..known.len()).is_some_and(|start| start.eq_ignore_ascii_case(known))
        };
        if let Some(known) = JOINT_NAMES.iter().find(similar) {
            let meant = format!("{}_{known}", column.quantity.name);
            let (file, column, joint, unit) =
                (table.file.clone(), name.clone(), joint.to_owned(), column.quantity.unit);
            return Err(LogError::JointName { file, column, joint, meant, unit });
        }
    }
    Ok(())
}

fn check_lengths(table: &Table) -> Result<(), LogError> {
    let expected = table.column("t").map_or(0, <[f64]>::len);
    if expected == 0 {
        return Err(LogError::Empty { file: table.file.clone() });
    }
    match table.columns.iter().find(|(_, cells)| cells.len() != expected) {
        Some((column, cells)) => {
            let (file, column) = (table.file.clone(), column.clone());
            Err(LogError::UnequalColumns { file, column, rows: cells.len(), expected })
        }
        None => Ok(()),
    }
}

/// Checks that every cell is finite, or missing if allowed, and that gains are not negative.
fn check_cells(table: &Table) -> Result<(), LogError> {
    for (name, cells) in &table.columns {
        let quantity = Column::parse(name).map(|column| column.quantity);
        let required = quantity.is_some_and(|quantity| quantity.cells == MissingCells::Forbidden);
        let gain = quantity.is_some_and(|quantity| matches!(quantity.name, "kp" | "kd"));
        for (row, &value) in cells.iter().enumerate() {
            if value.is_nan() && required {
                return Err(LogError::MissingCell { place: table.place(name, row) });
            }
            if value.is_infinite() {
                return Err(LogError::NotFinite { place: table.place(name, row), value });
            }
            if gain && value < 0.0 {
                return Err(LogError::NegativeGain { place: table.place(name, row), gain: value });
            }
        }
    }
    Ok(())
}

/// Removes a column of indices and returns it; zeros if there is no such column.
fn take_index(table: &mut Table, name: &str, rows: usize) -> Result<Vec<u32>, LogError> {
    let Some(cells) = table.take(name) else { return Ok(vec![0; rows]) };
    let index = |(row, &value): (usize, &f64)| {
        let whole = value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value);
        if whole { Ok(value as u32) } else { Err(LogError::NotAnIndex { place: table.place(name, row), value }) }
    };
    cells.iter().enumerate().map(index).collect()
}

fn check_segments(table: &Table, segment: &[u32], meta: &Meta) -> Result<(), LogError> {
    let described = meta.segments.len();
    match segment.iter().enumerate().find(|&(_, &segment)| segment as usize >= described) {
        Some((row, &segment)) => {
            Err(LogError::UnknownSegment { place: table.place("segment", row), segment, described })
        }
        None => Ok(()),
    }
}

fn check_time(table: &Table, segment: &[u32], episode: &[u32]) -> Result<(), LogError> {
    let t = table.column("t").unwrap_or_default();
    for rows in contiguous_ranges(segment, episode) {
        for row in rows.skip(1) {
            if t[row] <= t[row - 1] {
                return Err(LogError::TimeNotIncreasing {
                    place: table.place("t", row),
                    t: t[row],
                    before: t[row - 1],
                });
            }
        }
    }
    Ok(())
}

/// Checks that quaternions without missing cells have unit norm.
fn check_quaternion(table: &Table) -> Result<(), LogError> {
    const TOLERANCE: f64 = 0.01;
    let parts = ["quat_w", "quat_x", "quat_y", "quat_z"].map(|name| table.column(name));
    let [Some(w), Some(x), Some(y), Some(z)] = parts else { return Ok(()) };
    for row in 0..w.len() {
        let norm = [w, x, y, z].map(|part| part[row] * part[row]).iter().sum::<f64>().sqrt();
        // The comparison is false for NaN, so rows with missing cells pass.
        if (norm - 1.0).abs() > TOLERANCE {
            return Err(LogError::QuaternionNorm { place: table.place("quat_w", row), norm });
        }
    }
    Ok(())
}

/// Checks that lists of gains in the metadata have one for each joint.
fn check_gains(meta: &Meta, meta_file: &Path, joints: &[String]) -> Result<(), LogError> {
    for (gain, constant) in [("kp", &meta.kp), ("kd", &meta.kd)] {
        if let Some(Gain::PerJoint(gains)) = constant
            && gains.len() != joints.len()
        {
            let value = format!("{gains:?}");
            let expected = "one number, or one for each joint";
            return Err(LogError::MetaValue { file: meta_file.into(), key: gain.to_owned(), value, expected });
        }
    }
    Ok(())
}
