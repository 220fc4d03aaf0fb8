//! A log on the joints of a robot.

use std::ops::Range;

use twinstep_logs::replay::ReplayError;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::RobotTree;

use crate::{InferenceError, Quantity};

/// Longest time between two rows of a range [s].
const LONGEST_GAP_S: f64 = 1.0;

/// Commands and measurements of one joint, with one entry per row.
#[derive(Clone, Debug)]
pub struct JointChannels {
    /// Name in the log.
    pub name: String,
    /// Index of the joint in the robot.
    pub joint: usize,
    /// Measured position [rad].
    pub q: Vec<f64>,
    /// Measured velocity [rad/s].
    pub dq: Option<Vec<f64>>,
    /// Torque of the motor current, mean from a row to the next [N·m].
    pub tau: Option<Vec<f64>>,
    /// Commanded position [rad].
    pub q_cmd: Vec<f64>,
    /// Commanded velocity [rad/s].
    pub dq_cmd: Vec<f64>,
    /// Commanded torque [N·m].
    pub tau_ff: Vec<f64>,
    /// Position gain [N·m/rad]; `None` if it is unknown.
    pub kp: Option<Vec<f64>>,
    /// Velocity gain [N·m·s/rad].
    pub kd: Option<Vec<f64>>,
}

/// Selected rows of a contiguous range.
#[derive(Clone, Debug, PartialEq)]
pub struct SelectedRows {
    /// The selected rows.
    pub rows: Range<usize>,
    /// The contiguous range, whose earlier commands arrive in the selected rows after their delay.
    pub range: Range<usize>,
    /// Rotation world-from-base, `[w, x, y, z]`; `None` for that of the robot file.
    pub base_orientation: Option<[f64; 4]>,
}

/// A log on the joints of a robot: rows with a fixed base.
#[derive(Clone, Debug)]
pub struct JointLog {
    /// Time of each row [s].
    pub t: Vec<f64>,
    /// The rows that are compared.
    pub selected: Vec<SelectedRows>,
    /// The joints of the log, in the order of the robot.
    pub joints: Vec<JointChannels>,
    /// Nominal rate of the rows [Hz].
    pub rate_hz: f64,
}

impl JointLog {
    /// Matches the joints of `log` with those of `robot`, and takes the rows that `keep` selects.
    ///
    /// Names are equal up to case and the suffix `_joint`.
    pub fn new(log: &Log, robot: &RobotTree, keep: impl Fn(usize) -> bool) -> Result<Self, InferenceError> {
        let indices = joint_indices(log.joints(), robot)?;
        let joints = log.joints().iter().zip(indices).map(|(name, joint)| channels(log, name, joint));
        let mut joints = joints.collect::<Result<Vec<_>, _>>()?;
        joints.sort_by_key(|channels| channels.joint);
        check_rate(log)?;
        let mut selected = Vec::new();
        for (segment, range) in
            log.segments().flat_map(|(segment, range)| split_at_gaps(log, range).map(move |part| (segment, part)))
        {
            if !segment.base.is_fixed() {
                continue;
            }
            let kept: Vec<usize> = range.clone().filter(|row| keep(*row)).collect();
            for part in kept.chunk_by(|one, next| one + 1 == *next).filter(|part| part.len() > 1) {
                let base_orientation = mean_orientation(log, &range).or(log.meta().base_quat);
                let rows = part[0]..part[part.len() - 1] + 1;
                selected.push(SelectedRows { rows, range: range.clone(), base_orientation });
            }
        }
        if selected.is_empty() {
            return Err(InferenceError::NothingToSimulate);
        }
        Ok(Self { t: log.increasing_t(), selected, joints, rate_hz: log.meta().rate_hz })
    }

    /// Returns true if a gain of a joint is unknown.
    pub fn has_unknown_gains(&self) -> bool {
        self.joints.iter().any(|joint| joint.kp.is_none() || joint.kd.is_none())
    }

    /// Returns true if the log states the gain of a joint of the robot. True for other quantities.
    pub fn states_gain(&self, quantity: Quantity, joint: usize) -> bool {
        let channels = self.joints.iter().filter(|channels| channels.joint == joint);
        let mut stated = channels.map(|channels| match quantity {
            Quantity::PositionGain => channels.kp.is_some(),
            Quantity::VelocityGain => channels.kd.is_some(),
            _ => true,
        });
        stated.all(|stated| stated)
    }
}

/// Checks that the rows have a rate that can be simulated, as in `twinstep_logs::replay`.
fn check_rate(log: &Log) -> Result<(), InferenceError> {
    let mut steps: Vec<f64> =
        log.segments().flat_map(|(_, rows)| log.t()[rows].windows(2).map(|pair| pair[1] - pair[0])).collect();
    steps.sort_by(f64::total_cmp);
    let Some(median) = steps.get(steps.len() / 2) else { return Err(InferenceError::NothingToSimulate) };
    if (0.0004..=0.051).contains(median) {
        return Ok(());
    }
    Err(ReplayError::Rate { period_ms: 1e3 * median }.into())
}

/// Splits a contiguous range of rows where the log has no row for [`LONGEST_GAP_S`].
fn split_at_gaps(log: &Log, range: Range<usize>) -> impl Iterator<Item = Range<usize>> {
    let t = log.t();
    let starts = (range.start + 1..range.end).filter(|row| t[*row] - t[row - 1] > LONGEST_GAP_S);
    let starts: Vec<usize> = std::iter::once(range.start).chain(starts).chain([range.end]).collect();
    (1..starts.len()).map(move |part| starts[part - 1]..starts[part])
}

/// Returns the joint of the robot for each joint of the log, also if one of the names ends with `_joint`.
pub fn joint_indices(names: &[String], robot: &RobotTree) -> Result<Vec<usize>, InferenceError> {
    let plain = |name: &str| name.to_lowercase().trim_end_matches("_joint").to_owned();
    let mut found = Vec::<usize>::new();
    for name in names {
        let same = |joint: &usize| plain(&robot.joints[*joint].name) == plain(name);
        let joint = robot.joint(name).or_else(|| (0..robot.joints.len()).find(same));
        let unknown = || {
            let free = robot.joints.iter().find(|joint| !names.contains(&joint.name));
            let joints: Vec<_> = robot.joints.iter().map(|joint| joint.name.as_str()).collect();
            let example = free.map_or("joint", |joint| joint.name.as_str()).to_owned();
            InferenceError::UnknownJoint { joint: name.clone(), joints: joints.join(", "), example }
        };
        let joint = joint.ok_or_else(unknown)?;
        if let Some(other) = found.iter().position(|other| *other == joint) {
            return Err(InferenceError::SameJoint { one: names[other].clone(), other: name.clone() });
        }
        found.push(joint);
    }
    Ok(found)
}

fn channels(log: &Log, name: &str, joint: usize) -> Result<JointChannels, InferenceError> {
    let missing = |quantity| InferenceError::Missing { joint: name.to_owned(), quantity };
    let or_zero = |cells: Option<&[f64]>| {
        let zero_if_missing = |cell: &f64| if cell.is_finite() { *cell } else { 0.0 };
        cells.map_or_else(|| vec![0.0; log.rows()], |cells| cells.iter().map(zero_if_missing).collect())
    };
    let [kp, kd] = log.gains(name);
    let has_current = log.meta().tau_sensor == TorqueSensor::MotorCurrent;
    Ok(JointChannels {
        name: name.to_owned(),
        joint,
        q: log.q(name).ok_or_else(|| missing("q"))?.to_vec(),
        dq: log.dq(name).map(<[f64]>::to_vec),
        tau: log.tau_measured(name).filter(|_| has_current).map(<[f64]>::to_vec),
        q_cmd: log.q_cmd(name).ok_or_else(|| missing("q_cmd"))?.to_vec(),
        dq_cmd: or_zero(log.dq_cmd(name)),
        tau_ff: or_zero(log.tau_ff(name)),
        kp,
        kd,
    })
}

/// Returns the mean orientation of the base in some rows, `None` if it was not measured.
fn mean_orientation(log: &Log, rows: &Range<usize>) -> Option<[f64; 4]> {
    let parts = ["quat_w", "quat_x", "quat_y", "quat_z"].map(|name| log.channel(name));
    let [w, x, y, z] = [parts[0]?, parts[1]?, parts[2]?, parts[3]?];
    let mut sum = [0.0; 4];
    for row in rows.clone() {
        let quat = [w[row], x[row], y[row], z[row]];
        // A quaternion and its negative are the same orientation.
        let sign = if quat.iter().zip(&sum).map(|(one, other)| one * other).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
        if quat.iter().all(|part| part.is_finite()) {
            sum.iter_mut().zip(quat).for_each(|(sum, part)| *sum += sign * part);
        }
    }
    let norm = sum.iter().map(|part| part * part).sum::<f64>().sqrt();
    (norm > 0.0).then(|| sum.map(|part| part / norm))
}
