//! The channels of a log that the equations use, by joint of the robot.

use std::ops::Range;

use rayon::prelude::*;
use twinstep_logs::{Log, TorqueSensor};

use super::robot::Robot;
use super::smoother::smoothed;

/// Speed of the joints above which a robot on the ground moves: root mean square over [`REGIME_S`] [rad/s].
const MOVING_SPEED: f64 = 0.7;
/// Time over which the speed is averaged [s].
const REGIME_S: f64 = 0.5;
/// Longest time without a row in a range [s].
const LONGEST_GAP_S: f64 = 0.1;
/// Usual noise of a gyroscope [rad/s].
const GYRO_NOISE: f64 = 0.02;
/// Usual noise of the height of the base [m].
const HEIGHT_NOISE: f64 = 0.001;

/// What the robot does in a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Regime {
    /// The base is fixed.
    Hang,
    /// The base is free and the joints move slowly.
    Stand,
    /// The base is free and the joints move fast.
    Move,
}

/// Commands and measurements of one joint, by row.
#[derive(Clone, Debug)]
pub struct JointRows {
    /// Index of the joint in the robot.
    pub joint: usize,
    /// Measured position [rad].
    pub q: Vec<f64>,
    /// Measured velocity [rad/s].
    pub dq: Vec<f64>,
    /// Position [rad] and velocity [rad/s] with less noise.
    pub smooth: [Vec<f64>; 2],
    /// Measured torque, mean from the row to the next, zero without sensors. Not a number in rows that are not used [N·m].
    pub torque: Vec<f64>,
    /// Commanded position [rad], velocity [rad/s] and torque [N·m].
    pub command: [Vec<f64>; 3],
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad].
    pub gains: [Vec<f64>; 2],
    /// Motor temperature [°C]; empty if it was not measured.
    pub temperature: Vec<f64>,
}

/// Measurements at the base, by row.
#[derive(Clone, Debug)]
pub struct BaseRows {
    /// World-from-base, w x y z.
    pub orientation: Vec<[f64; 4]>,
    /// Reading of the gyroscope [rad/s].
    pub gyro: Vec<[f64; 3]>,
    /// The same with less noise [rad/s].
    pub smooth_gyro: Vec<[f64; 3]>,
    /// Reading of the accelerometer [m/s²]; empty if it was not measured.
    pub acceleration: Vec<[f64; 3]>,
    /// Velocity in the world frame [m/s]; empty if it was not measured.
    pub velocity: Vec<[f64; 3]>,
    /// Position in the world frame [m]; empty if it was not measured.
    pub position: Vec<[f64; 3]>,
    /// Standard deviation of its noise along the vertical [m].
    pub height_noise: f64,
}

/// Measurements of a log.
#[derive(Clone, Debug)]
pub struct Measurements {
    /// Time of each row [s].
    pub t: Vec<f64>,
    /// Median time between rows [s].
    pub dt: f64,
    /// Contiguous ranges of rows.
    pub ranges: Vec<Range<usize>>,
    /// What the robot does in each row.
    pub regime: Vec<Regime>,
    /// The joints of the log, in the order of the robot.
    pub joints: Vec<JointRows>,
    /// The base, if orientation and angular velocity were measured.
    pub base: Option<BaseRows>,
    /// True where a foot touches the ground, by foot and row; `None` in a row without a reading. Empty if it was not measured.
    pub contact: Vec<Vec<Option<bool>>>,
    /// Supply voltage divided by the highest of the log; empty if it was not measured.
    pub voltage_share: Vec<f64>,
    /// True if torques were measured.
    pub has_torque: bool,
    /// True if the torque sensors are between gear and link, false if motor currents were measured.
    pub is_at_output: bool,
    /// Standard deviation of the noise of position [rad], velocity [rad/s] and torque [N·m].
    pub noise: [f64; 3],
}

impl Measurements {
    /// Collects the channels of `log`, and the torques of the rows that are used.
    ///
    /// Returns `None` if it has no velocities or gains of a joint, if it has no torques and the base is fixed, or if the joints are not
    /// those of the robot.
    pub fn new(log: &Log, robot: &Robot, is_used: impl Fn(usize) -> bool) -> Option<Self> {
        let sensor = log.meta().tau_sensor;
        let has_torque = sensor != TorqueSensor::None;
        if !has_torque && log.segments().all(|(segment, _)| segment.base.is_fixed()) {
            return None;
        }
        let plain = |name: &str| name.to_lowercase().trim_end_matches("_joint").to_owned();
        let mut joints = Vec::new();
        for name in log.joints() {
            let joint = robot.tree.joints.iter().position(|joint| plain(&joint.name) == plain(name))?;
            joints.push(joint_rows(log, name, joint, has_torque)?);
        }
        joints.sort_by_key(|rows: &JointRows| rows.joint);
        for rows in &mut joints {
            // A drive remembers the rows that are not used, but their torques are not compared.
            rows.torque
                .iter_mut()
                .enumerate()
                .filter(|(row, _)| !is_used(*row))
                .for_each(|(_, torque)| *torque = f64::NAN);
        }
        if joints.len() != robot.joints.len() {
            return None;
        }
        let t = log.increasing_t();
        let ranges: Vec<Range<usize>> = log.segments().flat_map(|(_, range)| split_at_gaps(&t, range)).collect();
        let mut steps: Vec<f64> =
            ranges.iter().flat_map(|range| t[range.clone()].windows(2).map(|pair| pair[1] - pair[0])).collect();
        steps.sort_by(f64::total_cmp);
        let dt = *steps.get(steps.len() / 2)?;
        let mut regime = vec![Regime::Hang; t.len()];
        for (_, range) in log.segments().filter(|(segment, _)| !segment.base.is_fixed()) {
            let speeds = mean_square_speed(&joints, range.clone(), (REGIME_S / dt).round() as usize);
            for (row, speed) in range.zip(speeds) {
                regime[row] = if speed > MOVING_SPEED * MOVING_SPEED { Regime::Move } else { Regime::Stand };
            }
        }
        let stated = |channel: &str, usual: f64| {
            let all = log.joints().iter().filter_map(|joint| log.noise(&format!("{channel}_{joint}")));
            let (sum, count) = all.fold((0.0, 0.0), |(sum, count), noise| (sum + noise, count + 1.0));
            if count > 0.0 && sum > 0.0 { (sum / count, true) } else { (usual, false) }
        };
        let [of_q, of_dq] = [stated("q", 1e-4), stated("dq", 0.01)];
        let noise = [of_q.0, of_dq.0, stated("tau_measured", 0.05).0];
        joints.par_iter_mut().for_each(|rows| rows.smooth = smoothed(&t, [&rows.q, &rows.dq], [of_q, of_dq], &ranges));
        let highest = log.channel("battery_V").map_or(0.0, |cells| cells.iter().copied().fold(0.0, f64::max));
        let voltage = log.channel("battery_V").filter(|_| highest > 0.0).map(filled);
        let share = |cell: f64| cell / highest;
        Some(Self {
            base: base_rows(log, &t, &ranges),
            contact: contact_rows(log, robot),
            has_torque,
            is_at_output: sensor == TorqueSensor::JointOutput,
            voltage_share: voltage.map_or(Vec::new(), |cells| cells.into_iter().map(share).collect()),
            t,
            dt,
            ranges,
            regime,
            joints,
            noise,
        })
    }
}

fn joint_rows(log: &Log, name: &str, joint: usize, has_torque: bool) -> Option<JointRows> {
    let or_zero = |cells: Option<&[f64]>| cells.map_or(vec![0.0; log.rows()], <[f64]>::to_vec);
    let [kp, kd] = log.gains(name);
    Some(JointRows {
        joint,
        smooth: [Vec::new(), Vec::new()],
        q: log.q(name)?.to_vec(),
        dq: log.dq(name)?.to_vec(),
        torque: if has_torque { log.tau_measured(name)?.to_vec() } else { vec![0.0; log.rows()] },
        command: [log.q_cmd(name)?.to_vec(), or_zero(log.dq_cmd(name)), or_zero(log.tau_ff(name))],
        gains: [kp?, kd?],
        temperature: log.channel(&format!("temp_{name}")).map_or(Vec::new(), filled),
    })
}

/// Returns a series whose missing cells have the value before, or the first one; empty if it has no values. Slow sensors are read in few rows.
fn filled(cells: &[f64]) -> Vec<f64> {
    let Some(first) = cells.iter().copied().find(|cell| cell.is_finite()) else { return Vec::new() };
    let mut last = first;
    let mut next = |cell: &f64| {
        if cell.is_finite() {
            last = *cell;
        }
        last
    };
    cells.iter().map(&mut next).collect()
}

fn vectors<const N: usize>(log: &Log, names: [&str; N]) -> Option<Vec<[f64; N]>> {
    let channels: Option<Vec<&[f64]>> = names.into_iter().map(|name| log.channel(name)).collect();
    let channels = channels?;
    Some((0..log.rows()).map(|row| std::array::from_fn(|axis| channels[axis][row])).collect())
}

fn base_rows(log: &Log, t: &[f64], ranges: &[Range<usize>]) -> Option<BaseRows> {
    let names = ["gyro_x", "gyro_y", "gyro_z"];
    let gyro = vectors(log, names)?;
    let smooth = |axis: usize| {
        let noise = log.noise(names[axis]).filter(|noise| *noise > 0.0);
        let noise = noise.map_or((GYRO_NOISE, false), |noise| (noise, true));
        let readings: Vec<f64> = gyro.iter().map(|reading| reading[axis]).collect();
        // An impact changes a rate as it changes the velocity of a joint; the angle is not read.
        let [_, smooth] = smoothed(t, [&vec![f64::NAN; t.len()], &readings], [(1.0, true), noise], ranges);
        smooth
    };
    let smooth = [0, 1, 2].map(smooth);
    Some(BaseRows {
        orientation: vectors(log, ["quat_w", "quat_x", "quat_y", "quat_z"])?,
        smooth_gyro: (0..t.len()).map(|row| [0, 1, 2].map(|axis| smooth[axis][row])).collect(),
        gyro,
        acceleration: vectors(log, ["acc_x", "acc_y", "acc_z"]).unwrap_or_default(),
        velocity: vectors(log, ["vel_x", "vel_y", "vel_z"]).unwrap_or_default(),
        position: vectors(log, ["pos_x", "pos_y", "pos_z"]).unwrap_or_default(),
        height_noise: log.noise("pos_z").filter(|noise| *noise > 0.0).unwrap_or(HEIGHT_NOISE),
    })
}

/// Returns whether each foot touches the ground by row; empty if the log does not tell it of all feet.
fn contact_rows(log: &Log, robot: &Robot) -> Vec<Vec<Option<bool>>> {
    robot.feet.iter().map(|foot| log.contacts(&foot.name, 0.0)).collect::<Option<_>>().unwrap_or_default()
}

fn split_at_gaps(t: &[f64], range: Range<usize>) -> Vec<Range<usize>> {
    let breaks = (range.start + 1..range.end).filter(|row| t[*row] - t[row - 1] > LONGEST_GAP_S);
    let starts: Vec<usize> = std::iter::once(range.start).chain(breaks).chain([range.end]).collect();
    starts.windows(2).map(|pair| pair[0]..pair[1]).filter(|range| range.len() > 20).collect()
}

/// Returns the mean square speed of the joints around each row.
fn mean_square_speed(joints: &[JointRows], range: Range<usize>, half: usize) -> Vec<f64> {
    let squares = |row: usize| {
        let finite = joints.iter().map(|joint| joint.dq[row]).filter(|speed| speed.is_finite());
        finite.map(|speed| speed * speed).sum::<f64>() / joints.len() as f64
    };
    let mut sums = vec![0.0];
    for row in range.clone() {
        sums.push(sums[sums.len() - 1] + squares(row));
    }
    (0..range.len())
        .map(|index| {
            let (from, to) = (index.saturating_sub(half), (index + half + 1).min(range.len()));
            (sums[to] - sums[from]) / (to - from) as f64
        })
        .collect()
}
