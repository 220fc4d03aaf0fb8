//! Excitation of each joint: range of position, speed, torque, reversals and frequencies.

use serde::Serialize;
use twinstep_model::{Joint, JointModel, go2};

use crate::statistics::{largest, quantile, root_mean_square};
use crate::{Log, TorqueSensor};

/// Excitation of a joint: of its measured motion, or of its commands in a motion file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Excitation {
    /// Name of the joint.
    pub joint: String,
    /// Lowest position [rad].
    pub q_min: f64,
    /// Highest position [rad].
    pub q_max: f64,
    /// Least distance of the position to the joint's limits [rad]; negative beyond them, `None` if they are unknown.
    pub limit_distance: Option<f64>,
    /// Highest speed [rad/s]; `None` if no two rows are consecutive.
    pub speed_max: Option<f64>,
    /// Root mean square of the speed [rad/s].
    pub speed_rms: Option<f64>,
    /// Speed limit of the joint [rad/s], if it is known.
    pub speed_limit: Option<f64>,
    /// Source of the speed.
    pub speed_from: SpeedSource,
    /// Highest absolute torque [N·m]; `None` if it was not measured and cannot be computed by the PD law.
    pub torque_max: Option<f64>,
    /// Root mean square of the torque [N·m].
    pub torque_rms: Option<f64>,
    /// Torque limit of the joint [N·m], if it is known.
    pub torque_limit: Option<f64>,
    /// Source of the torque.
    pub torque_from: TorqueSource,
    /// Number of sign changes of the velocity, without speeds below 5 % of the highest.
    #[serde(rename = "turns")]
    pub reversals: usize,
    /// Frequencies of the motion [Hz]: 10 % and 90 % quantiles of 1 / (2 × time between two reversals).
    pub band_hz: Option<[f64; 2]>,
}

/// Source of a speed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SpeedSource {
    /// The column `dq_<joint>`.
    Measured,
    /// Finite differences of positions.
    Derived,
}

/// Source of a torque.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TorqueSource {
    /// The column `tau_measured_<joint>`.
    Measured,
    /// PD law: kp·(q_cmd − q) + kd·(dq_cmd − dq) + tau_ff.
    Commanded,
}

/// Times [s] and velocities [rad/s] of a joint, for each contiguous range of rows.
pub(crate) type Velocity = Vec<Vec<(f64, f64)>>;

/// Returns the excitation of a joint. Returns `None` if the log has neither its position nor its command.
pub(crate) fn excitation(log: &Log, joint: &str) -> Option<Excitation> {
    let q = log.q(joint).or_else(|| log.q_cmd(joint))?;
    let (q_min, q_max) = (-largest(q.iter().map(|q| -q))?, largest(q.iter().copied())?);
    let known = model(joint);
    let (velocity, speed_from) = velocity(log, joint, q);
    let speeds = || velocity.iter().flatten().map(|(_, dq)| dq.abs());
    let speed_max = largest(speeds());
    let (torque, torque_from) = torque(log, joint);
    let reversals = reversal_times(&velocity, 0.05 * speed_max.unwrap_or(0.0));
    Some(Excitation {
        joint: joint.to_owned(),
        q_min,
        q_max,
        limit_distance: known.map(|model| (q_min - model.range[0]).min(model.range[1] - q_max)),
        speed_max,
        speed_rms: root_mean_square(speeds()),
        speed_limit: known.map(|model| model.speed_limit),
        speed_from,
        torque_max: largest(torque.iter().map(|torque| torque.abs())),
        torque_rms: root_mean_square(torque.iter().copied()),
        torque_limit: known.map(|model| model.torque_limit),
        torque_from,
        reversals: reversals.iter().map(Vec::len).sum(),
        band_hz: band(&reversals),
    })
}

fn model(joint: &str) -> Option<JointModel> {
    let joint: Joint = joint.parse().ok()?;
    Some(go2().joints[joint.index()])
}

/// Returns the measured velocity, or finite differences of `q` at the midpoints of the rows.
pub(crate) fn velocity(log: &Log, joint: &str, q: &[f64]) -> (Velocity, SpeedSource) {
    let t = log.t();
    let ranges = log.segments().map(|(_, rows)| rows);
    if let Some(dq) = log.dq(joint).filter(|dq| dq.iter().any(|dq| !dq.is_nan())) {
        let known =
            |rows: std::ops::Range<usize>| rows.map(|row| (t[row], dq[row])).filter(|(_, dq)| !dq.is_nan()).collect();
        return (ranges.map(known).collect(), SpeedSource::Measured);
    }
    let derived = |rows: std::ops::Range<usize>| {
        let pairs = rows.clone().zip(rows.skip(1));
        pairs.map(|(row, next)| (f64::midpoint(t[row], t[next]), (q[next] - q[row]) / (t[next] - t[row]))).collect()
    };
    (ranges.map(derived).collect(), SpeedSource::Derived)
}

/// Returns the measured torque, or that of the PD law; empty if neither is known.
fn torque(log: &Log, joint: &str) -> (Vec<f64>, TorqueSource) {
    if let Some(measured) = log.tau_measured(joint).filter(|_| log.meta().tau_sensor != TorqueSensor::None) {
        return (measured.to_vec(), TorqueSource::Measured);
    }
    let (Some(q), Some(q_cmd)) = (log.q(joint), log.q_cmd(joint)) else { return (Vec::new(), TorqueSource::Commanded) };
    let (dq, dq_cmd, tau_ff) = (log.dq(joint), log.dq_cmd(joint), log.tau_ff(joint));
    let cell = |column: Option<&[f64]>, row: usize| column.map_or(0.0, |cells| cells[row]);
    let [Some(kp), Some(kd)] = log.gains(joint) else { return (Vec::new(), TorqueSource::Commanded) };
    let commanded = |row: usize| {
        // Without measured velocity the damping term is omitted; it is small if the joint tracks its command.
        let damping = if dq.is_some() { kd[row] * (cell(dq_cmd, row) - cell(dq, row)) } else { 0.0 };
        kp[row] * (q_cmd[row] - q[row]) + damping + cell(tau_ff, row)
    };
    ((0..log.rows()).map(commanded).collect(), TorqueSource::Commanded)
}

/// Returns the times [s] of sign changes among velocities above `threshold`, for each contiguous range of rows.
fn reversal_times(velocity: &Velocity, threshold: f64) -> Vec<Vec<f64>> {
    let in_range = |range: &Vec<(f64, f64)>| {
        let mut sign = 0.0;
        let mut reversals = Vec::new();
        for (t, dq) in range.iter().filter(|(_, dq)| dq.abs() > threshold) {
            if sign * dq < 0.0 {
                reversals.push(*t);
            }
            sign = dq.signum();
        }
        reversals
    };
    velocity.iter().map(in_range).collect()
}

fn band(reversals: &[Vec<f64>]) -> Option<[f64; 2]> {
    let times = reversals.iter().flat_map(|times| times.windows(2).map(|pair| pair[1] - pair[0]));
    let mut halves: Vec<f64> = times.collect();
    halves.sort_by(f64::total_cmp);
    Some([0.9, 0.1].map(|fraction| quantile(&halves, fraction)).map(|half| half.map(|half| 0.5 / half)))
        .and_then(|band| Some([band[0]?, band[1]?]))
}
