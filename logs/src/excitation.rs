//! How much each joint moved: how far, how fast, how hard, how often back and forth.

use serde::Serialize;
use twinstep_model::{Joint, JointModel, go2};

use crate::describe::{largest, quantile};
use crate::{Log, TorqueSensor};

/// How much a joint moved; of a motion, how much it is told to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Excitation {
    /// The joint's name.
    pub joint: String,
    /// Lowest position [rad].
    pub q_min: f64,
    /// Highest position [rad].
    pub q_max: f64,
    /// How near the position came to the joint's limits [rad]; negative beyond them, none for a joint without known ones.
    pub limit_distance: Option<f64>,
    /// Highest speed [rad/s]; none without two rows in a segment.
    pub speed_max: Option<f64>,
    /// Root mean square of the speed [rad/s].
    pub speed_rms: Option<f64>,
    /// The joint's highest possible speed [rad/s], where it is known.
    pub speed_limit: Option<f64>,
    /// Whether the speed was measured, or derived from the position by differences.
    pub speed_from: SpeedSource,
    /// Highest absolute torque [N·m]; none where neither the torque nor all that a PD law needs is known.
    pub torque_max: Option<f64>,
    /// Root mean square of the torque [N·m].
    pub torque_rms: Option<f64>,
    /// The joint's highest possible torque [N·m], where it is known.
    pub torque_limit: Option<f64>,
    /// Whether the torque was measured, or is what the PD law asks for.
    pub torque_from: TorqueSource,
    /// How often the velocity changed its sign; speeds below a twentieth of the highest do not count.
    pub reversals: usize,
    /// Frequencies of the motion [Hz]: what half of a time between two turns stands for, between its 10 % and 90 % quantiles.
    pub band_hz: Option<[f64; 2]>,
}

/// Where a speed comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SpeedSource {
    /// The column `dq_<joint>`.
    Measured,
    /// Differences of positions.
    Derived,
}

/// Where a torque comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TorqueSource {
    /// The column `tau_measured_<joint>`.
    Measured,
    /// kp·(q_cmd − q) + kd·(dq_cmd − dq) + tau_ff.
    Commanded,
}

/// A joint's velocity at one time [s, rad/s], part by part of the log.
pub(crate) type Velocity = Vec<Vec<(f64, f64)>>;

/// The excitation of a joint; none for a joint of which nothing is known.
pub(crate) fn excitation(log: &Log, joint: &str) -> Option<Excitation> {
    let q = log.q(joint).or_else(|| log.q_cmd(joint))?;
    let (q_min, q_max) = (-largest(q.iter().map(|q| -q))?, largest(q.iter().copied())?);
    let known = model(joint);
    let (velocity, speed_from) = velocity(log, joint, q);
    let speeds = || velocity.iter().flatten().map(|(_, dq)| dq.abs());
    let speed_max = largest(speeds());
    let (torque, torque_from) = torque(log, joint);
    let turns = reversal_times(&velocity, 0.05 * speed_max.unwrap_or(0.0));
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
        reversals: turns.iter().map(Vec::len).sum(),
        band_hz: band(&turns),
    })
}

fn model(joint: &str) -> Option<JointModel> {
    let joint: Joint = joint.parse().ok()?;
    Some(go2().joints[joint.index()])
}

/// The measured velocity, or that of differences of `q`, which lies in the middle of its rows.
pub(crate) fn velocity(log: &Log, joint: &str, q: &[f64]) -> (Velocity, SpeedSource) {
    let t = log.t();
    let parts = log.segments().map(|(_, rows)| rows);
    if let Some(dq) = log.dq(joint).filter(|dq| dq.iter().any(|dq| !dq.is_nan())) {
        let known =
            |rows: std::ops::Range<usize>| rows.map(|row| (t[row], dq[row])).filter(|(_, dq)| !dq.is_nan()).collect();
        return (parts.map(known).collect(), SpeedSource::Measured);
    }
    let derived = |rows: std::ops::Range<usize>| {
        let pairs = rows.clone().zip(rows.skip(1));
        pairs.map(|(row, next)| (f64::midpoint(t[row], t[next]), (q[next] - q[row]) / (t[next] - t[row]))).collect()
    };
    (parts.map(derived).collect(), SpeedSource::Derived)
}

/// The measured torque, or that of the PD law; empty where neither is known.
fn torque(log: &Log, joint: &str) -> (Vec<f64>, TorqueSource) {
    if let Some(measured) = log.tau_measured(joint).filter(|_| log.meta().tau_sensor != TorqueSensor::None) {
        return (measured.to_vec(), TorqueSource::Measured);
    }
    let (Some(q), Some(q_cmd)) = (log.q(joint), log.q_cmd(joint)) else { return (Vec::new(), TorqueSource::Commanded) };
    let (dq, dq_cmd, tau_ff) = (log.dq(joint), log.dq_cmd(joint), log.tau_ff(joint));
    let cell = |column: Option<&[f64]>, row: usize| column.map_or(0.0, |cells| cells[row]);
    let commanded = |row: usize| {
        let (kp, kd) = (log.kp(joint, row)?, log.kd(joint, row)?);
        // Without a measured velocity damping is left out: its share is small where the joint follows.
        let damping = if dq.is_some() { kd * (cell(dq_cmd, row) - cell(dq, row)) } else { 0.0 };
        Some(kp * (q_cmd[row] - q[row]) + damping + cell(tau_ff, row))
    };
    ((0..log.rows()).filter_map(commanded).collect(), TorqueSource::Commanded)
}

/// The times at which the velocity has changed its sign and exceeds `threshold`, part by part [s].
fn reversal_times(velocity: &Velocity, threshold: f64) -> Vec<Vec<f64>> {
    let of_part = |part: &Vec<(f64, f64)>| {
        let mut sign = 0.0;
        let mut turns = Vec::new();
        for (t, dq) in part.iter().filter(|(_, dq)| dq.abs() > threshold) {
            if sign * dq < 0.0 {
                turns.push(*t);
            }
            sign = dq.signum();
        }
        turns
    };
    velocity.iter().map(of_part).collect()
}

fn band(turns: &[Vec<f64>]) -> Option<[f64; 2]> {
    let mut halves: Vec<f64> = turns.iter().flat_map(|turns| turns.windows(2).map(|pair| pair[1] - pair[0])).collect();
    halves.sort_by(f64::total_cmp);
    Some([0.9, 0.1].map(|fraction| quantile(&halves, fraction)).map(|half| half.map(|half| 0.5 / half)))
        .and_then(|band| Some([band[0]?, band[1]?]))
}

fn root_mean_square(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) =
        values.filter(|value| !value.is_nan()).fold((0, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    (count > 0).then(|| (sum / f64::from(count)).sqrt())
}
