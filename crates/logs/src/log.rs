//! Measured log in memory.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use twinstep_model::Joint;

use crate::columns::Column;
use crate::meta::{Gain, Meta, Segment};

/// Commands and measurements of a robot, row by row. The contents are validated.
///
/// The sensors of a row are sampled at its `t`. Its commands are in force from `t` to the next row, and `tau_measured`
/// is the mean over that interval. Two logs are equal if their metadata and columns are equal. Ignored columns do not
/// count, and missing cells are equal to each other.
#[derive(Clone, Debug)]
pub struct Log {
    pub(crate) meta: Meta,
    pub(crate) t: Vec<f64>,
    pub(crate) segment: Vec<u32>,
    pub(crate) episode: Vec<u32>,
    pub(crate) joints: Vec<String>,
    pub(crate) channels: BTreeMap<String, Vec<f64>>,
    pub(crate) ignored: Vec<String>,
    pub(crate) notes: Vec<String>,
    /// Rate of the measurements of a log without repeats [Hz].
    pub(crate) measured_hz: Option<f64>,
}

impl Log {
    /// Returns the metadata.
    pub fn meta(&self) -> &Meta {
        &self.meta
    }

    /// Returns the time of each row [s], which increases within a segment of an episode.
    pub fn t(&self) -> &[f64] {
        &self.t
    }

    /// Returns the index of each row's segment in the metadata; zeros if the file has no such column.
    pub fn segment(&self) -> &[u32] {
        &self.segment
    }

    /// Returns the episode of each row, which changes when the robot is reset; zeros if the file has no such column.
    pub fn episode(&self) -> &[u32] {
        &self.episode
    }

    /// Returns the names of the joints, in the order of the metadata, or else of their columns.
    pub fn joints(&self) -> &[String] {
        &self.joints
    }

    /// Returns the joints, in the order of [`Log::joints`]. Returns `None` if one is not a joint of the Go2.
    pub fn go2_joints(&self) -> Option<Vec<Joint>> {
        self.joints.iter().map(|joint| joint.parse().ok()).collect()
    }

    /// Returns the ignored columns of the file: unknown names, and joints that the metadata do not list.
    pub fn ignored(&self) -> &[String] {
        &self.ignored
    }

    /// Returns the warnings from reading the file, as sentences.
    pub fn read_warnings(&self) -> &[String] {
        &self.notes
    }

    /// Returns the number of rows, at least one.
    pub fn rows(&self) -> usize {
        self.t.len()
    }

    /// Returns the recorded time [s], without the pauses between the ranges of [`Log::segments`].
    pub fn duration_s(&self) -> f64 {
        self.segments().map(|(_, rows)| self.t[rows.end - 1] - self.t[rows.start]).sum()
    }

    /// Returns the contiguous ranges of rows in one segment of one episode, each with its segment.
    pub fn segments(&self) -> impl Iterator<Item = (&Segment, Range<usize>)> {
        contiguous_ranges(&self.segment, &self.episode)
            .map(|rows| (&self.meta.segments[self.segment[rows.start] as usize], rows))
    }

    /// Returns a channel by its column name, such as `gyro_x`. A missing cell is NaN.
    pub fn channel(&self, name: &str) -> Option<&[f64]> {
        self.channels.get(name).map(Vec::as_slice)
    }

    /// Returns all channels by column name, without `t`, `segment` and `episode`.
    pub fn channels(&self) -> impl Iterator<Item = (&str, &[f64])> {
        self.channels.iter().map(|(name, cells)| (name.as_str(), cells.as_slice()))
    }

    /// Returns the measured position [rad]. Only a motion file may lack it.
    pub fn q(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("q", joint)
    }

    /// Returns the measured velocity [rad/s].
    pub fn dq(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("dq", joint)
    }

    /// Returns the commanded position [rad].
    pub fn q_cmd(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("q_cmd", joint)
    }

    /// Returns the commanded velocity [rad/s]. `None` means zero.
    pub fn dq_cmd(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("dq_cmd", joint)
    }

    /// Returns the commanded feed-forward torque [N·m]. `None` means zero.
    pub fn tau_ff(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("tau_ff", joint)
    }

    /// Returns the measured torque [N·m], at the sensor location `tau_sensor` of [`Log::meta`].
    pub fn tau_measured(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("tau_measured", joint)
    }

    /// Returns the position gain in force from a row to the next [N·m/rad]. `None` if it is unknown.
    pub fn kp(&self, joint: &str, row: usize) -> Option<f64> {
        self.gain("kp", self.meta.kp.as_ref(), joint, row)
    }

    /// Returns the velocity gain in force from a row to the next [N·m·s/rad]. `None` if it is unknown.
    pub fn kd(&self, joint: &str, row: usize) -> Option<f64> {
        self.gain("kd", self.meta.kd.as_ref(), joint, row)
    }

    /// Returns position gain [N·m/rad] and velocity gain [N·m·s/rad] in force from each row to the next.
    pub fn gains(&self, joint: &str) -> [Option<Vec<f64>>; 2] {
        [("kp", &self.meta.kp), ("kd", &self.meta.kd)].map(|(quantity, constant)| {
            let index = self.joints.iter().position(|name| name == joint)?;
            match self.of_joint(quantity, joint).or_else(|| self.channel(quantity)) {
                Some(column) => Some(column.to_vec()),
                None => Some(vec![constant.as_ref()?.of(index)?; self.rows()]),
            }
        })
    }

    /// Returns the standard deviation of a channel's noise in the channel's unit, if the metadata state it.
    pub fn noise(&self, channel: &str) -> Option<f64> {
        let quantity = Column::parse(channel)?.quantity.name;
        self.meta.noise.get(channel).or_else(|| self.meta.noise.get(quantity)).copied()
    }

    fn of_joint(&self, quantity: &str, joint: &str) -> Option<&[f64]> {
        self.channel(&format!("{quantity}_{joint}"))
    }

    fn gain(&self, quantity: &str, constant: Option<&Gain>, joint: &str, row: usize) -> Option<f64> {
        let index = self.joints.iter().position(|name| name == joint)?;
        match self.of_joint(quantity, joint).or_else(|| self.channel(quantity)) {
            Some(column) => column.get(row).copied(),
            None => constant.filter(|_| row < self.rows())?.of(index),
        }
    }

    /// Returns the time of each row [s], increasing over the whole log: a segment whose clock begins again follows the one before after 1 s.
    pub fn increasing_t(&self) -> Vec<f64> {
        let mut times = self.t.clone();
        let mut last = f64::NEG_INFINITY;
        for (_, rows) in self.segments() {
            let late = if times[rows.start] > last { 0.0 } else { last + 1.0 - times[rows.start] };
            times[rows.clone()].iter_mut().for_each(|t| *t += late);
            last = times[rows.end - 1];
        }
        times
    }

    /// Returns the log with gains where it states none: `of` returns the position gain [N·m/rad] and the velocity gain [N·m·s/rad] of a joint.
    #[must_use]
    pub fn with_gains(mut self, of: impl Fn(&str) -> Option<[f64; 2]>) -> Self {
        for joint in self.joints.clone() {
            let stated = self.gains(&joint);
            let Some(given) = of(&joint) else { continue };
            for (index, quantity) in ["kp", "kd"].into_iter().enumerate() {
                if stated[index].is_none() {
                    self.channels.insert(format!("{quantity}_{joint}"), vec![given[index]; self.t.len()]);
                }
            }
        }
        self
    }

    /// Returns the log with this velocity of the base in the world frame [m/s], by axis and row.
    #[must_use]
    pub fn with_base_velocity(mut self, velocity: [Vec<f64>; 3]) -> Self {
        for (name, cells) in ["vel_x", "vel_y", "vel_z"].into_iter().zip(velocity) {
            self.channels.insert(name.to_owned(), cells);
        }
        self
    }

    /// Returns the log with the torque of each row in the row before, because a message cannot contain the torque of the time after it. The
    /// last row of a range has none.
    #[must_use]
    pub(crate) fn with_torques_before_messages(mut self) -> Self {
        let ranges: Vec<Range<usize>> = self.segments().map(|(_, rows)| rows).collect();
        let torques = self.channels.iter_mut().filter(|(name, _)| name.starts_with("tau_measured_"));
        for (_, cells) in torques {
            for rows in &ranges {
                cells[rows.clone()].rotate_left(1);
                cells[rows.end - 1] = f64::NAN;
            }
        }
        self
    }

    /// Joins logs of one robot: their segments follow each other, 10 s apart. Positions, velocities, torques, temperatures and voltage that one of them
    /// lacks are left out. Other sensors have no reading where they are missing, and commands of velocity and torque are 0.
    ///
    /// Returns `None` if they have other joints, torque sensors, rates or orientations of a fixed base, or one of them no gains.
    pub fn joined(logs: &[Self]) -> Option<Self> {
        let (first, others) = logs.split_first()?;
        let mut joined = Self { t: first.increasing_t(), ..first.clone() };
        if others.is_empty() {
            return Some(joined);
        }
        let is_alike = |log: &&Self| {
            log.joints == first.joints
                && log.meta.tau_sensor == first.meta.tau_sensor
                && log.meta.base_quat == first.meta.base_quat
                && (log.meta.rate_hz / first.meta.rate_hz - 1.0).abs() < 0.01
        };
        if !others.iter().all(|log| is_alike(&log)) {
            return None;
        }
        let in_all = |name: &str| logs.iter().all(|log| log.channels.contains_key(name));
        let is_needed = |name: &str| {
            let is_filled =
                ["q_", "dq_", "tau_measured_", "temp_", "battery_V"].iter().any(|start| name.starts_with(start));
            is_filled && !is_added_command(name)
        };
        let names: BTreeSet<&String> = logs.iter().flat_map(|log| log.channels.keys()).collect();
        let kept = names.into_iter().filter(|name| in_all(name) || !is_needed(name));
        joined.channels = kept.map(|name| (name.clone(), first.cells(name))).collect();
        for joint in &first.joints {
            for (index, quantity) in ["kp", "kd"].into_iter().enumerate() {
                let gains: Option<Vec<Vec<f64>>> = logs.iter().map(|log| log.gains(joint)[index].clone()).collect();
                joined.channels.insert(format!("{quantity}_{joint}"), gains?.concat());
            }
        }
        (joined.meta.kp, joined.meta.kd) = (None, None);
        for log in others {
            let times = log.increasing_t();
            let start = joined.t.last().map_or(0.0, |last| last + 10.0) - times.first().copied().unwrap_or(0.0);
            let segments = joined.meta.segments.len() as u32;
            joined.t.extend(times.iter().map(|t| start + t));
            joined.segment.extend(log.segment.iter().map(|segment| segments + segment));
            joined.episode.extend(&log.episode);
            joined.meta.segments.extend(log.meta.segments.iter().cloned());
            for (name, cells) in &mut joined.channels {
                if !["kp_", "kd_"].iter().any(|gain| name.starts_with(gain)) {
                    cells.extend(log.cells(name));
                }
            }
        }
        Some(joined)
    }

    /// Returns a channel. Where it is missing, commands are 0 and sensors have no reading.
    fn cells(&self, name: &str) -> Vec<f64> {
        let missing = if is_added_command(name) { 0.0 } else { f64::NAN };
        self.channels.get(name).cloned().unwrap_or_else(|| vec![missing; self.rows()])
    }

    /// Returns all columns, in the order in which they are written.
    pub(crate) fn columns(&self) -> Vec<NamedColumn<'_>> {
        let mut columns = vec![
            NamedColumn { name: "t".to_owned(), cells: ColumnCells::Number(&self.t) },
            NamedColumn { name: "segment".to_owned(), cells: ColumnCells::Index(&self.segment) },
            NamedColumn { name: "episode".to_owned(), cells: ColumnCells::Index(&self.episode) },
        ];
        let sort_key = |name: &str| {
            let column = Column::parse(name)?;
            Some((column.rank(), self.joints.iter().position(|joint| Some(joint.as_str()) == column.joint())))
        };
        let mut names: Vec<_> = self.channels.keys().collect();
        names.sort_by_key(|name| sort_key(name));
        columns.extend(
            names
                .into_iter()
                .map(|name| NamedColumn { name: name.clone(), cells: ColumnCells::Number(&self.channels[name]) }),
        );
        columns
    }
}

impl PartialEq for Log {
    fn eq(&self, other: &Log) -> bool {
        let same = |mine: &f64, its: &f64| mine == its || (mine.is_nan() && its.is_nan());
        self.meta == other.meta
            && self.joints == other.joints
            && self.t == other.t
            && self.segment == other.segment
            && self.episode == other.episode
            && self.channels.keys().eq(other.channels.keys())
            && self.channels.values().flatten().zip(other.channels.values().flatten()).all(|(a, b)| same(a, b))
    }
}

/// Column to write.
pub(crate) struct NamedColumn<'a> {
    pub name: String,
    pub cells: ColumnCells<'a>,
}

/// Cells of a column to write.
#[derive(Clone, Copy)]
pub(crate) enum ColumnCells<'a> {
    Index(&'a [u32]),
    Number(&'a [f64]),
}

impl ColumnCells<'_> {
    pub fn len(&self) -> usize {
        match self {
            ColumnCells::Index(cells) => cells.len(),
            ColumnCells::Number(cells) => cells.len(),
        }
    }
}

/// Returns true for the commands that a log may lack: those of velocity and torque.
fn is_added_command(name: &str) -> bool {
    name.starts_with("dq_cmd_") || name.starts_with("tau_ff_")
}

/// Returns the ranges of rows within which neither segment nor episode changes.
pub(crate) fn contiguous_ranges<'a>(
    segment: &'a [u32],
    episode: &'a [u32],
) -> impl Iterator<Item = Range<usize>> + use<'a> {
    let rows = segment.len();
    let mut start = 0;
    std::iter::from_fn(move || {
        if start == rows {
            return None;
        }
        let changed = |&row: &usize| segment[row] != segment[start] || episode[row] != episode[start];
        let end = (start + 1..rows).find(changed).unwrap_or(rows);
        let range = start..end;
        start = end;
        Some(range)
    })
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::TorqueSensor;

    fn log(kp: f64, extra: bool) -> Log {
        let segment = Segment { name: "air".to_owned(), base: BaseMount::Fixed };
        let mut meta = Meta::new(200.0, TorqueSensor::None, vec![segment]);
        (meta.kp, meta.kd) = (Some(Gain::Uniform(kp)), Some(Gain::Uniform(1.0)));
        let mut columns = BTreeMap::from([
            ("t".to_owned(), vec![0.0, 0.005]),
            ("q_elbow".to_owned(), vec![0.1, 0.2]),
            ("q_cmd_elbow".to_owned(), vec![kp, kp]),
        ]);
        if extra {
            columns.insert("dq_elbow".to_owned(), vec![0.0, 0.0]);
        }
        Log::new(meta, columns).expect("a log")
    }

    #[test]
    fn joined_logs_keep_their_gains_and_follow_each_other_in_segments_of_their_own() {
        let joined = Log::joined(&[log(20.0, true), log(30.0, false)]).expect("alike");
        assert_eq!(joined.gains("elbow")[0], Some(vec![20.0, 20.0, 30.0, 30.0]));
        assert_eq!(joined.segment(), [0, 0, 1, 1]);
        assert!(joined.t().windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!(joined.q_cmd("elbow"), Some([20.0, 20.0, 30.0, 30.0].as_slice()));
        assert_eq!(joined.dq("elbow"), None);
    }

    #[test]
    fn sensor_of_one_of_two_logs_has_no_reading_in_the_other() {
        let (mut walking, hanging) = (log(20.0, false), log(20.0, false));
        walking.channels.insert("gyro_x".to_owned(), vec![0.5, 0.6]);
        walking.channels.insert("tau_ff_elbow".to_owned(), vec![1.0, 2.0]);
        let joined = Log::joined(&[hanging, walking]).expect("alike");
        let gyro = joined.channel("gyro_x").expect("a channel");
        assert!(gyro[..2].iter().all(|cell| cell.is_nan()));
        assert_eq!(gyro[2..], [0.5, 0.6]);
        assert_eq!(joined.tau_ff("elbow"), Some([0.0, 0.0, 1.0, 2.0].as_slice()));
    }

    #[test]
    fn clock_that_begins_again_in_a_segment_goes_on() {
        let segment = |name: &str| Segment { name: name.to_owned(), base: BaseMount::Fixed };
        let meta = Meta::new(200.0, TorqueSensor::None, vec![segment("one"), segment("two")]);
        let columns = BTreeMap::from([
            ("t".to_owned(), vec![0.0, 0.005, 0.0, 0.005]),
            ("segment".to_owned(), vec![0.0, 0.0, 1.0, 1.0]),
            ("q_elbow".to_owned(), vec![0.1; 4]),
            ("q_cmd_elbow".to_owned(), vec![0.1; 4]),
        ]);
        let log = Log::new(meta, columns).expect("a log");
        let expected = [0.0, 0.005, 1.005, 1.01];
        assert!(log.increasing_t().iter().zip(expected).all(|(t, expected)| (t - expected).abs() < 1e-9));
    }

    #[test]
    fn gains_that_a_log_states_are_kept_and_others_are_added() {
        let mut log = log(20.0, false);
        log.meta.kd = None;
        let gains = log.with_gains(|_| Some([50.0, 3.0])).gains("elbow");
        assert_eq!(gains, [Some(vec![20.0, 20.0]), Some(vec![3.0, 3.0])]);
    }

    #[test]
    fn logs_of_other_joints_are_not_joined() {
        let mut other = log(20.0, false);
        other.joints[0] = "knee".to_owned();
        assert!(Log::joined(&[log(20.0, false), other]).is_none());
    }
}
