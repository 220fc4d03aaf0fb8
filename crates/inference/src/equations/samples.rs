//! Means of the measurements over a few rows, from which the balance of forces is computed.

use std::ops::Range;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use twinstep_dynamics::Vec3;
use twinstep_dynamics::tree::{TreeParameters, TreeState, TreeStructure};

use super::drive::{inverse, link_torque_with, smooth_sign};
use super::measurements::{JointRows, Measurements, Regime};
use super::robot::Robot;
use super::touch::Touch;
use super::undetermined::Weighting;

/// Gravitational acceleration [m/s²].
pub const GRAVITY: f64 = 9.81;
/// Time between samples of a fixed base, of one that stands, and of one that moves [s]. A sample is a mean over twice that time.
const SAMPLE_S: [f64; 3] = [0.02, 0.05, 0.02];
/// Speed below which dry friction is not determined [rad/s].
const LEAST_SPEED: f64 = 0.05;
/// Time after a robot was placed on the ground in which it drops and settles [s]. A Go2 that drops by 4 cm rests after 1.3 s.
///
/// With these rows the height of a payload came out 0.5 m too low, on a robot with dry friction. The likely reason is that the law of
/// friction has none at rest, where it is not determined; then this is a stand-in for friction at rest as an unknown.
const SETTLING_S: f64 = 1.5;

/// Motion in a sample.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Position [rad].
    pub q: Vec<f64>,
    /// Velocity [rad/s].
    pub dq: Vec<f64>,
    /// Acceleration [rad/s²].
    pub ddq: Vec<f64>,
    pub base: BaseMotion,
}

impl Motion {
    /// Returns position, velocity and acceleration of a joint.
    pub fn of(&self, joint: usize) -> [f64; 3] {
        [self.q[joint], self.dq[joint], self.ddq[joint]]
    }
}

/// Motion of the base in a sample.
#[derive(Clone, Copy, Debug, Default)]
pub struct BaseMotion {
    pub orientation: [f64; 4],
    pub angular_velocity: [f64; 3],
    pub angular_acceleration: [f64; 3],
    pub linear_acceleration: [f64; 3],
}

/// Means over some rows.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The rows.
    pub rows: Range<usize>,
    /// Time in the middle [s].
    pub t: f64,
    /// What the robot does.
    pub regime: Regime,
    /// Motion whose velocity and acceleration are from the velocity sensors: that of the residuals.
    pub response: Motion,
    /// Motion whose velocity and acceleration are from the position sensors: that of the columns, whose noise is independent.
    pub instrument: Motion,
    /// Weights of the rows.
    pub weights: Arc<Vec<f64>>,
    /// Weights, positions, velocities and their signs as friction has them, at some of the rows, by joint: a mean of a law is not the law of a mean.
    pub states: Vec<Vec<[f64; 4]>>,
    /// Forces and moments at the base per torque of a joint, by joint: not zero where the limb stands. Empty for a fixed base.
    pub base_per_torque: Vec<[f64; 6]>,
    /// Weights of the balance of the base; `None` for a fixed base.
    pub weighting: Option<Weighting>,
    /// True for a joint whose limb touches nothing, by joint.
    pub is_free: Vec<bool>,
    /// The feet that stand; on the ground only.
    pub touches: Vec<Touch>,
    /// True for a joint that turns in one direction all the time, so that its dry friction is known, by joint.
    pub turns: Vec<bool>,
}

impl Sample {
    /// Returns the mean of a series of torques, each from its row to the next.
    pub fn mean(&self, series: &[f64]) -> f64 {
        self.rows.clone().zip(self.weights.iter()).map(|(row, weight)| weight * series[row]).sum()
    }

    /// Returns mean, derivative and second derivative of a series of positions.
    pub fn motion(&self, measured: &Measurements, series: &[f64]) -> [f64; 3] {
        let dt = (measured.t[self.rows.end] - measured.t[self.rows.start]) / self.rows.len() as f64;
        let mut motion = [0.0; 3];
        for (row, weight) in self.rows.clone().zip(self.weights.iter()) {
            let [before, now, next, later] = [row - 1, row, row + 1, row + 2].map(|row| series[row]);
            motion[0] += weight * 0.5 * (now + next);
            motion[1] += weight * (next - now) / dt;
            motion[2] += weight * (later - next - now + before) / (2.0 * dt * dt);
        }
        motion
    }

    /// Returns the mean link torque for a motor torque [N·m], with the acceleration of the instrument.
    pub fn link_torque(&self, robot: &Robot, joint: usize, motor: f64) -> f64 {
        self.link_torque_at(robot, joint, motor, self.instrument.ddq[joint])
    }

    /// Returns the mean link torque for a motor torque [N·m] and an acceleration [rad/s²].
    pub fn link_torque_at(&self, robot: &Robot, joint: usize, motor: f64, ddq: f64) -> f64 {
        let torque = |[weight, q, dq, sign]: &[f64; 4]| {
            weight * link_torque_with(&robot.joints[joint], motor, [*q, *dq, ddq], *sign)
        };
        self.states[joint].iter().map(torque).sum()
    }

    /// Returns the torque of the motor [N·m] that has this torque on the link, the inverse of [`Self::link_torque`].
    pub fn motor_torque(&self, robot: &Robot, joint: usize, link: f64) -> f64 {
        inverse(robot.joints[joint].actuator.gain, link, |motor| self.link_torque(robot, joint, motor))
    }

    /// Returns the state of a motion, with gravity turned by an angle about each axis of the base [rad].
    pub fn state(&self, robot: &Robot, motion: &Motion, tilt: [f64; 3]) -> TreeState<f64> {
        let [w, x, y, z] = motion.base.orientation;
        let turn = DQuat::from_xyzw(x, y, z, w) * DQuat::from_scaled_axis(DVec3::from_array(tilt));
        let gyro = DVec3::from_array(motion.base.angular_velocity);
        let gyro = if self.regime == Regime::Hang { gyro } else { gyro - robot.gyro_bias };
        let offsets = robot.joints.iter().map(|joint| joint.actuator.encoder_offset);
        TreeState {
            orientation: [turn.w, turn.x, turn.y, turn.z],
            angular_velocity: Vec3(gyro.to_array()),
            q: motion.q.iter().zip(offsets).map(|(q, offset)| q - offset).collect(),
            dq: motion.dq.clone(),
            ..TreeState::origin(motion.q.len())
        }
    }
}

/// Collects the samples of a log; none if the bodies of the robot are not known.
pub fn samples(measured: &Measurements, robot: &Robot) -> Vec<Sample> {
    let mut samples = Vec::new();
    if !robot.has_bodies() {
        return samples;
    }
    let structure = TreeStructure::new(&robot.tree);
    let bodies = TreeParameters::splat(&robot.tree);
    let steps = SAMPLE_S.map(|time| ((time / measured.dt).round() as usize).max(1));
    let weights = steps.map(|step| Arc::new(weights(2 * step)));
    for range in &measured.ranges {
        let mut start = range.start + MARGIN;
        while start + MARGIN < range.end {
            let regime = measured.regime[start];
            let step = steps[regime as usize];
            let rows = start..start + 2 * step;
            start += step;
            let settles = measured.t[rows.start] - measured.t[range.start] < SETTLING_S;
            if rows.end + MARGIN >= range.end
                || measured.regime[rows.end] != regime
                || (regime == Regime::Stand && settles)
            {
                continue;
            }
            if let Some(mut sample) = sample(measured, rows, regime, &weights[regime as usize]) {
                if regime != Regime::Hang
                    && (robot.feet.is_empty() || !sample.set_feet(measured, robot, &structure, &bodies))
                {
                    continue;
                }
                samples.push(sample);
            }
        }
    }
    samples
}

/// Most rows of a sample at which laws of joints are evaluated.
const MOST_STATES: usize = 8;

/// Rows that the derivatives of a sample need before and after it.
const MARGIN: usize = 12;

/// Returns weights of rows that begin and end smoothly, so that derivatives of the mean are differences of the weights.
pub fn weights(length: usize) -> Vec<f64> {
    let bump = |row: usize| (std::f64::consts::PI * (row as f64 + 0.5) / length as f64).sin().powi(2);
    let sum: f64 = (0..length).map(bump).sum();
    (0..length).map(|row| bump(row) / sum).collect()
}

fn sample(measured: &Measurements, rows: Range<usize>, regime: Regime, weights: &Arc<Vec<f64>>) -> Option<Sample> {
    let dt = (measured.t[rows.end] - measured.t[rows.start]) / rows.len() as f64;
    let sum = |value: &dyn Fn(usize) -> f64| {
        rows.clone().zip(weights.iter()).map(|(row, weight)| weight * value(row)).sum::<f64>()
    };
    let middle_of = |value: &dyn Fn(usize) -> f64| sum(&|row| 0.5 * (value(row) + value(row + 1)));
    let slope_of = |value: &dyn Fn(usize) -> f64| sum(&|row| (value(row + 1) - value(row)) / dt);
    let middle = |series: &[f64]| middle_of(&|row| series[row]);
    let slope = |series: &[f64]| slope_of(&|row| series[row]);
    let second = |series: &[f64]| {
        sum(&|row| (series[row + 2] - series[row + 1] - series[row] + series[row - 1]) / (2.0 * dt * dt))
    };
    let joints = || measured.joints.iter();
    let base = base_motion(measured, &rows, regime, &|value| [middle_of(value), slope_of(value)])?;
    let response = Motion {
        q: joints().map(|joint| middle(&joint.q)).collect(),
        dq: joints().map(|joint| middle(&joint.dq)).collect(),
        ddq: joints().map(|joint| slope(&joint.dq)).collect(),
        base: base[0],
    };
    let instrument = Motion {
        q: response.q.clone(),
        dq: joints().map(|joint| slope(&joint.q)).collect(),
        ddq: joints().map(|joint| second(&joint.q)).collect(),
        base: base[1],
    };
    let torques: f64 = joints().map(|joint| sum(&|row| joint.torque[row])).sum();
    let numbers = response.q.iter().chain(&response.dq).chain(&response.ddq).chain(&instrument.ddq);
    let known = torques.is_finite() && numbers.copied().all(f64::is_finite);
    let t = 0.5 * (measured.t[rows.start] + measured.t[rows.end]);
    let weights = weights.clone();
    let step = rows.len().div_ceil(MOST_STATES);
    let kept = || rows.clone().zip(weights.iter()).step_by(step);
    let sum_of_weights: f64 = kept().map(|(_, weight)| weight).sum();
    let states = |joint: &JointRows| -> Vec<[f64; 4]> {
        let state = |(row, weight): (usize, &f64)| {
            let [q, dq] = [0, 1].map(|of| 0.5 * (joint.smooth[of][row] + joint.smooth[of][row + 1]));
            [weight / sum_of_weights, q, dq, smooth_sign(dq)]
        };
        kept().map(state).collect()
    };
    let states = joints().map(states).collect();
    let turns = |joint: &JointRows| {
        let speeds = &joint.smooth[1][rows.start..=rows.end];
        speeds.iter().all(|speed| *speed > LEAST_SPEED) || speeds.iter().all(|speed| *speed < -LEAST_SPEED)
    };
    let turns = joints().map(turns).collect();
    let (is_free, base_per_torque) = (vec![true; measured.joints.len()], Vec::new());
    known.then_some(Sample {
        rows,
        t,
        regime,
        response,
        instrument,
        weights,
        states,
        base_per_torque,
        weighting: None,
        touches: Vec::new(),
        is_free,
        turns,
    })
}

/// Returns mean and derivative over the rows of a sample, given a value of each row.
type Means<'a> = dyn Fn(&dyn Fn(usize) -> f64) -> [f64; 2] + 'a;

/// Returns the motion of the base for the residuals, and with independent noise for the columns; `None` if it is not known.
///
/// `of` returns mean and derivative of a value of each row.
fn base_motion(measured: &Measurements, rows: &Range<usize>, regime: Regime, of: &Means) -> Option<[BaseMotion; 2]> {
    let still = BaseMotion { orientation: [1.0, 0.0, 0.0, 0.0], ..BaseMotion::default() };
    let Some(base) = &measured.base else { return (regime == Regime::Hang).then_some([still; 2]) };
    let middle = usize::midpoint(rows.start, rows.end);
    let orientations = [middle, middle + 1].map(|row| base.orientation[row]);
    let known = orientations.iter().flatten().all(|part| part.is_finite());
    let turned = orientations.map(|orientation| if known { BaseMotion { orientation, ..still } } else { still });
    if regime == Regime::Hang {
        return Some(turned);
    }
    let axis = |series: &[[f64; 3]], axis: usize| of(&|row| series[row][axis]);
    if !known {
        return None;
    }
    let gyro = [0, 1, 2].map(|index| axis(&base.smooth_gyro, index));
    let into_base = |world: [f64; 3]| {
        let [w, x, y, z] = orientations[0];
        (DQuat::from_xyzw(x, y, z, w).normalize().inverse() * DVec3::from_array(world)).to_array()
    };
    let of_velocity =
        (!base.velocity.is_empty()).then(|| into_base([0, 1, 2].map(|index| axis(&base.velocity, index)[1])));
    let of_velocity = of_velocity.filter(|acceleration| acceleration.iter().all(|part| part.is_finite()));
    // The accelerometer is less noisy than a derivative, and has gravity in it. The columns have the acceleration of the other sensor,
    // whose noise is independent, or that of gravity alone.
    let felt = (!base.acceleration.is_empty()).then(|| {
        let up = into_base([0.0, 0.0, GRAVITY]);
        [0, 1, 2].map(|index| axis(&base.acceleration, index)[0] - up[index])
    });
    // One of several logs may lack the sensor.
    let [linear_acceleration, of_columns] = match felt.filter(|felt| felt.iter().all(|part| part.is_finite())) {
        Some(felt) => [felt, of_velocity.unwrap_or([0.0; 3])],
        // A robot that stands is not accelerated for long.
        None if regime == Regime::Stand => [of_velocity.unwrap_or([0.0; 3]), [0.0; 3]],
        None => [of_velocity?, [0.0; 3]],
    };
    let angular_velocity = gyro.map(|of| of[0]);
    // Orientations are too noisy for angular accelerations.
    let angular_acceleration = gyro.map(|of| of[1]);
    let response = BaseMotion { angular_velocity, angular_acceleration, linear_acceleration, ..turned[0] };
    let instrument =
        BaseMotion { angular_velocity, angular_acceleration, linear_acceleration: of_columns, ..turned[1] };
    let numbers = response.angular_velocity.iter().chain(&response.angular_acceleration);
    numbers.chain(&response.linear_acceleration).copied().all(f64::is_finite).then_some([response, instrument])
}
