//! Balance of forces: the torques of the motors against the equations of motion, on a base that is fixed or stands on its feet.
//!
//! A fixed base balances whatever it needs, so every joint has an equation of its own. On the ground the force on a foot is unknown: the
//! three joints of its limb give it, and the base must balance with the forces of all feet. Nothing is simulated, and contact needs no
//! model.

use std::ops::Range;
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use twinstep_dynamics::Vec3;
use twinstep_dynamics::tree::{
    TreeAcceleration, TreeMotion, TreeParameters, TreeState, TreeStructure, inverse_dynamics,
};
use twinstep_model::{RigidBody, RobotTree};

use super::block::{Block, Column};
use super::drive::{link_torque, motor_torque};
use super::measurements::{Measurements, Regime};
use super::robot::Robot;

/// Gravitational acceleration [m/s²].
pub const GRAVITY: f64 = 9.81;
/// Time between samples of a fixed base, and of one that stands [s]. A sample is a mean over twice that time.
const SAMPLE_S: [f64; 2] = [0.02, 0.05];
/// Speed below which dry friction is not determined [rad/s].
const LEAST_SPEED: f64 = 0.05;

/// Motion in a sample.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Position [rad].
    pub q: Vec<f64>,
    /// Velocity [rad/s].
    pub dq: Vec<f64>,
    /// Acceleration [rad/s²].
    pub ddq: Vec<f64>,
    base: BaseMotion,
}

impl Motion {
    /// Returns position, velocity and acceleration of a joint.
    pub fn of(&self, joint: usize) -> [f64; 3] {
        [self.q[joint], self.dq[joint], self.ddq[joint]]
    }
}

/// Motion of the base in a sample.
#[derive(Clone, Copy, Debug, Default)]
struct BaseMotion {
    orientation: [f64; 4],
    angular_velocity: [f64; 3],
    angular_acceleration: [f64; 3],
    linear_acceleration: [f64; 3],
}

/// Means over some rows.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The rows.
    pub rows: Range<usize>,
    /// Time in the middle [s].
    t: f64,
    /// What the robot does.
    regime: Regime,
    /// Motion whose velocity and acceleration are from the velocity sensors: that of the residuals.
    response: Motion,
    /// Motion whose velocity and acceleration are from the position sensors: that of the columns, whose noise is independent.
    pub instrument: Motion,
    /// Weights of the rows.
    weights: Arc<Vec<f64>>,
    /// Forces and moments at the base per torque of a joint, by joint; empty for a fixed base.
    base_per_torque: Vec<[f64; 6]>,
}

/// Samples, and where their residuals are in the blocks.
pub struct Balance {
    /// The samples.
    pub samples: Vec<Sample>,
    /// Block and row of each residual of a sample.
    places: Vec<Vec<(usize, usize, usize)>>,
    /// Blocks of this balance: index and number of rows.
    sizes: Vec<usize>,
    first_block: usize,
    structure: TreeStructure,
    bodies: TreeParameters<f64>,
    joints: usize,
    /// Robot of the columns of motion.
    reference: Robot,
    /// Moment and force at the base, and torques of the joints, that the motion of the columns needs, by sample.
    pub needed: Vec<Vec<f64>>,
    /// The measured torques minus what the motion needs, for the reference, by sample.
    first_lacking: Vec<Vec<f64>>,
}

impl Balance {
    /// Collects the samples, and adds their blocks.
    pub fn new(measured: &Measurements, robot: &Robot, blocks: &mut Vec<Block>) -> Self {
        let samples = samples(measured, robot);
        let joints = robot.joints.len();
        let mut balance = Self {
            samples,
            places: Vec::new(),
            sizes: Vec::new(),
            first_block: blocks.len(),
            structure: TreeStructure::new(&robot.tree),
            bodies: TreeParameters::splat(&robot.tree),
            joints,
            reference: robot.clone(),
            needed: Vec::new(),
            first_lacking: Vec::new(),
        };
        let needed = |sample: &Sample| balance.needed(&balance.bodies, robot, sample, &sample.instrument, [0.0; 3]);
        balance.needed = balance.samples.par_iter().map(needed).collect();
        balance.first_lacking = balance.lacking(measured);
        balance.add_blocks(measured, robot, blocks);
        balance
    }

    fn add_blocks(&mut self, measured: &Measurements, robot: &Robot, blocks: &mut Vec<Block>) {
        let noise = |regime: Regime| {
            let usual = weights(4);
            let rows = self.samples.iter().find(|sample| sample.regime == regime).map_or(&usual, |one| &*one.weights);
            // Torque, and a link's inertia times the acceleration: differences of the weights.
            let padded: Vec<f64> = std::iter::once(0.0).chain(rows.iter().copied()).chain([0.0]).collect();
            let steps = padded.windows(2).map(|pair| (pair[1] - pair[0]).powi(2)).sum::<f64>().sqrt() / measured.dt;
            let torque = measured.noise[2] * rows.iter().map(|weight| weight * weight).sum::<f64>().sqrt();
            let inertial = if regime == Regime::Hang { 0.03 } else { 0.05 };
            (torque * torque + (inertial * measured.noise[1] * steps).powi(2)).sqrt()
        };
        let mut series: Vec<Block> = Vec::new();
        for joint in 0..self.joints {
            let name = format!("joint {} hang", robot.tree.joints[joint].name);
            let sigma = noise(Regime::Hang);
            series.push(Block { name, t: Vec::new(), y: Vec::new(), sigma });
        }
        for axis in ["mx", "my", "mz", "fx", "fy", "fz"] {
            let lever = if axis.starts_with('f') { 10.0 } else { 2.0 };
            let sigma = lever * noise(Regime::Stand);
            series.push(Block { name: format!("base {axis} stand"), t: Vec::new(), y: Vec::new(), sigma });
        }
        let first = self.first_block;
        for sample in &self.samples {
            let residuals: Vec<usize> = match sample.regime {
                Regime::Hang => {
                    (0..self.joints).filter(|joint| sample.instrument.dq[*joint].abs() > LEAST_SPEED).collect()
                }
                _ => (self.joints..self.joints + 6).collect(),
            };
            let place = |residual: usize| (residual, first + residual, series[residual].t.len());
            let places: Vec<_> = residuals.iter().map(|residual| place(*residual)).collect();
            for residual in residuals {
                series[residual].t.push(sample.t);
                series[residual].y.push(0.0);
            }
            self.places.push(places);
        }
        self.sizes = series.iter().map(|block| block.t.len()).collect();
        blocks.extend(series);
    }

    /// Returns what is lacking for the robot of the columns, by sample: the measured torques minus what the motion needs.
    fn lacking(&self, measured: &Measurements) -> Vec<Vec<f64>> {
        let robot = &self.reference;
        let lacking = |sample: &Sample| {
            let mut lacking = self.needed(&self.bodies, robot, sample, &sample.response, [0.0; 3]);
            for force in &mut lacking {
                *force = -*force;
            }
            for (joint, rows) in measured.joints.iter().enumerate() {
                let motor = sample.mean(&rows.torque);
                lacking[6 + joint] += link_torque(&robot.joints[joint], motor, sample.response.of(joint));
            }
            lacking
        };
        self.samples.par_iter().map(lacking).collect()
    }

    /// Returns moment and force at the base, and the torques of the joints, that the motion of the columns needs with a robot's bodies.
    ///
    /// `shifts` is how a link moves differently from its encoder, by joint and sample; empty for a stiff gear.
    pub fn needed_by(&self, robot: &Robot, shifts: &[Vec<[f64; 3]>]) -> Vec<Vec<f64>> {
        let offset =
            |robot: &Robot| robot.joints.iter().map(|joint| joint.actuator.encoder_offset).collect::<Vec<f64>>();
        let same = shifts.iter().all(Vec::is_empty)
            && robot.tree == self.reference.tree
            && offset(robot) == offset(&self.reference)
            && robot.gyro_bias == self.reference.gyro_bias;
        if same {
            return self.needed.clone();
        }
        let bodies = TreeParameters::splat(&robot.tree);
        let needed = |(index, sample): (usize, &Sample)| {
            let mut motion = sample.instrument.clone();
            for (joint, shift) in shifts.iter().enumerate().filter(|(_, shift)| !shift.is_empty()) {
                let [q, dq, ddq] = shift[index];
                motion.q[joint] += q;
                motion.dq[joint] += dq;
                motion.ddq[joint] += ddq;
            }
            self.needed(&bodies, robot, sample, &motion, [0.0; 3])
        };
        self.samples.par_iter().enumerate().map(needed).collect()
    }

    /// Returns the torques of the motors with which a robot is in balance, by sample and joint, close to those of its drives.
    ///
    /// Columns of the torques of motors are computed from them. Otherwise what the model lacks would be in the columns, too, and a robot
    /// with smaller motors and masses would lack less.
    pub fn balanced_motors(&self, robot: &Robot, needed: &[Vec<f64>], drives: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let balanced = |(index, sample): (usize, &Sample)| {
            let needed = &needed[index];
            let mut links: Vec<f64> = match sample.regime {
                Regime::Hang => needed[6..].to_vec(),
                _ => (0..self.joints).map(|joint| sample.link_torque(robot, joint, drives[joint][index])).collect(),
            };
            if sample.regime != Regime::Hang {
                let per = DMatrix::from_fn(6, self.joints, |axis, joint| sample.base_per_torque[joint][axis]);
                let lacking: Vec<f64> = needed
                    .iter()
                    .enumerate()
                    .map(|(row, force)| if row < 6 { -force } else { links[row - 6] - force })
                    .collect();
                let left = DVector::from_fn(6, |axis, _| self.projected(sample, &lacking, self.joints + axis));
                let square = &per * per.transpose();
                if let Some(share) = square.cholesky() {
                    let change = per.transpose() * share.solve(&left);
                    links.iter_mut().zip(change.iter()).for_each(|(link, change)| *link += change);
                }
            }
            let motion = |joint: usize| sample.instrument.of(joint);
            (0..self.joints).map(|joint| motor_torque(&robot.joints[joint], links[joint], motion(joint))).collect()
        };
        self.samples.par_iter().enumerate().map(balanced).collect()
    }

    /// Returns true if the log has samples of a robot that stands.
    pub fn stands(&self) -> bool {
        self.samples.iter().any(|sample| sample.regime == Regime::Stand)
    }

    /// Writes the residuals of a robot, given what its motion needs and the torques of its motors in balance.
    ///
    /// `delayed` is by how much the torque of a motor differs because its sensor is late, by joint and sample.
    pub fn write_residuals(
        &self,
        robot: &Robot,
        needed: &[Vec<f64>],
        motors: &[Vec<f64>],
        delayed: &[Vec<f64>],
        blocks: &mut [Block],
    ) {
        for (index, sample) in self.samples.iter().enumerate() {
            let mut all = self.first_lacking[index].clone();
            for (force, (now, before)) in all.iter_mut().zip(needed[index].iter().zip(&self.needed[index])) {
                *force -= now - before;
            }
            for joint in 0..self.joints {
                let motor = motors[index][joint];
                all[6 + joint] += sample.link_torque(robot, joint, motor)
                    - sample.link_torque(&self.reference, joint, motor)
                    + delayed[joint].get(index).copied().unwrap_or(0.0);
            }
            for (residual, block, row) in &self.places[index] {
                blocks[*block].y[*row] = self.projected(sample, &all, *residual);
            }
        }
    }

    /// Returns the column of a change of the torque on a joint's link, by sample [N·m].
    pub fn joint_column(&self, joint: usize, change: &[f64]) -> Column {
        self.column(|index, residual| {
            let sample = &self.samples[index];
            match sample.regime {
                Regime::Hang if residual == joint => -change[index],
                Regime::Hang => 0.0,
                _ => sample.base_per_torque[joint][residual - self.joints] * change[index],
            }
        })
    }

    /// Returns the column of another tree of bodies.
    pub fn body_column(&self, tree: &RobotTree, robot: &Robot) -> Column {
        let bodies = TreeParameters::splat(tree);
        let before = TreeParameters::splat(&robot.tree);
        self.needed_column(|_, sample| {
            let first = self.needed(&before, robot, sample, &sample.instrument, [0.0; 3]);
            less(self.needed(&bodies, robot, sample, &sample.instrument, [0.0; 3]), &first)
        })
    }

    /// Returns the column of additional inertia of one body.
    pub fn inertia_column(&self, tree: &RobotTree, robot: &Robot, body: usize, added: RigidBody) -> Column {
        let mut only = tree.clone();
        only.bodies.iter_mut().for_each(|body| {
            body.inertia = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };
        });
        only.bodies[body].inertia = added;
        let parameters = TreeParameters::splat(&only);
        self.needed_column(|_, sample| self.needed(&parameters, robot, sample, &sample.instrument, [0.0; 3]))
    }

    /// Returns the column of a motion of the links that differs from that of the encoders: position, velocity and acceleration of one
    /// joint, by sample.
    pub fn motion_column(&self, joint: usize, change: &[[f64; 3]]) -> Column {
        self.needed_column(|index, sample| {
            let mut motion = sample.instrument.clone();
            let [q, dq, ddq] = change[index];
            motion.q[joint] += q;
            motion.dq[joint] += dq;
            motion.ddq[joint] += ddq;
            less(self.needed(&self.bodies, &self.reference, sample, &motion, [0.0; 3]), &self.needed[index])
        })
    }

    /// Returns the column of the time by which the positions of a joint's encoder are ahead of its velocities [s].
    pub fn lead_column(&self, joint: usize) -> Column {
        let accelerations: Vec<f64> = self.samples.iter().map(|sample| sample.instrument.ddq[joint]).collect();
        let change = |index: usize| [0.0, accelerations[index], self.slope(&accelerations, index)];
        self.motion_column(joint, &(0..accelerations.len()).map(change).collect::<Vec<_>>())
    }

    /// Returns the derivative of a series by sample; zero at the ends of a contiguous range.
    pub fn slope(&self, series: &[f64], index: usize) -> f64 {
        self.step_around(index).map_or(0.0, |step| (series[index + 1] - series[index - 1]) / (2.0 * step))
    }

    /// Returns the second derivative of a series by sample; zero at the ends of a contiguous range.
    pub fn curvature(&self, series: &[f64], index: usize) -> f64 {
        let second = |step: f64| (series[index + 1] - 2.0 * series[index] + series[index - 1]) / (step * step);
        self.step_around(index).map_or(0.0, second)
    }

    /// Returns the time to the samples before and after one [s]; `None` if one of them is missing.
    fn step_around(&self, index: usize) -> Option<f64> {
        let [earlier, now, later] = [index.checked_sub(1)?, index, index + 1].map(|index| self.samples.get(index));
        let (earlier, now, later) = (earlier?, now?, later?);
        let contiguous = earlier.rows.contains(&now.rows.start) && now.rows.contains(&later.rows.start);
        contiguous.then_some(0.5 * (later.t - earlier.t))
    }

    /// Returns the column of an acceleration of a base that stands, along an axis of the base [m/s²].
    pub fn acceleration_column(&self, axis: usize) -> Column {
        self.needed_column(|index, sample| {
            if sample.regime == Regime::Hang {
                return vec![0.0; 6 + self.joints];
            }
            let mut motion = sample.instrument.clone();
            motion.base.linear_acceleration[axis] += 1.0;
            less(self.needed(&self.bodies, &self.reference, sample, &motion, [0.0; 3]), &self.needed[index])
        })
    }

    /// Returns the column of a rotation of gravity about an axis of the base [rad], where the base is fixed.
    pub fn tilt_column(&self, axis: usize) -> Column {
        let mut tilt = [0.0; 3];
        tilt[axis] = 1e-3;
        self.needed_column(|index, sample| {
            if sample.regime != Regime::Hang {
                return vec![0.0; 6 + self.joints];
            }
            let turned = self.needed(&self.bodies, &self.reference, sample, &sample.instrument, tilt);
            less(turned, &self.needed[index]).into_iter().map(|change| change / 1e-3).collect()
        })
    }

    fn needed_column(&self, change: impl Fn(usize, &Sample) -> Vec<f64> + Send + Sync) -> Column {
        let changes: Vec<Vec<f64>> =
            self.samples.par_iter().enumerate().map(|(index, sample)| change(index, sample)).collect();
        // The residual has the needed forces with a negative sign, so that the column has a positive one.
        self.column(|index, residual| self.projected(&self.samples[index], &changes[index], residual))
    }

    fn column(&self, value: impl Fn(usize, usize) -> f64) -> Column {
        let mut parts: Vec<(usize, Vec<f64>)> =
            self.sizes.iter().enumerate().map(|(index, size)| (self.first_block + index, vec![0.0; *size])).collect();
        for (index, places) in self.places.iter().enumerate() {
            for (residual, block, row) in places {
                parts[block - self.first_block].1[*row] = value(index, *residual);
            }
        }
        parts.retain(|(_, rows)| rows.iter().any(|row| *row != 0.0));
        Column { parts }
    }

    /// Returns a residual, given moment and force at the base and the torques of the joints.
    fn projected(&self, sample: &Sample, forces: &[f64], residual: usize) -> f64 {
        if residual < self.joints {
            return forces[6 + residual];
        }
        let axis = residual - self.joints;
        let of_joints = sample.base_per_torque.iter().enumerate().map(|(joint, per)| per[axis] * forces[6 + joint]);
        forces[axis] - of_joints.sum::<f64>()
    }

    /// Returns moment and force at the base, and the torque of each joint, that a motion needs.
    fn needed(
        &self,
        bodies: &TreeParameters<f64>,
        robot: &Robot,
        sample: &Sample,
        motion: &Motion,
        tilt: [f64; 3],
    ) -> Vec<f64> {
        let state = sample.state(robot, motion, tilt);
        let mut places = TreeMotion::empty(bodies);
        places.set(bodies, &state, GRAVITY);
        let acceleration = TreeAcceleration {
            angular: Vec3(motion.base.angular_acceleration),
            linear: Vec3(motion.base.linear_acceleration),
            ddq: motion.ddq.clone(),
        };
        let forces = inverse_dynamics(&self.structure, bodies, &places, &acceleration);
        [forces.moment.0.as_slice(), &forces.force.0, &forces.tau].concat()
    }
}

impl Sample {
    /// Returns the mean of a series of torques, each from its row to the next.
    pub fn mean(&self, series: &[f64]) -> f64 {
        self.rows.clone().zip(self.weights.iter()).map(|(row, weight)| weight * series[row]).sum()
    }

    /// Returns the link torque of the instrument for a motor torque [N·m].
    pub fn link_torque(&self, robot: &Robot, joint: usize, motor: f64) -> f64 {
        link_torque(&robot.joints[joint], motor, self.instrument.of(joint))
    }

    fn state(&self, robot: &Robot, motion: &Motion, tilt: [f64; 3]) -> TreeState<f64> {
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

fn less(mut forces: Vec<f64>, others: &[f64]) -> Vec<f64> {
    forces.iter_mut().zip(others).for_each(|(force, other)| *force -= other);
    forces
}

/// Returns a series as it was before the delay of the torque sensor of a joint.
pub fn advanced(measured: &Measurements, joint: usize, robot: &Robot, series: &[f64]) -> Vec<f64> {
    let delay = robot.joints[joint].actuator.sensor_delay / measured.dt;
    if delay == 0.0 {
        return series.to_vec();
    }
    let at = |row: usize| {
        let (whole, part) = (delay.floor() as usize, delay.fract());
        let last = series.len() - 1;
        (1.0 - part) * series[(row + whole).min(last)] + part * series[(row + whole + 1).min(last)]
    };
    (0..series.len()).map(at).collect()
}

fn samples(measured: &Measurements, robot: &Robot) -> Vec<Sample> {
    let mut samples = Vec::new();
    let structure = TreeStructure::new(&robot.tree);
    let bodies = TreeParameters::splat(&robot.tree);
    for range in &measured.ranges {
        let hangs = measured.regime[range.start] == Regime::Hang;
        let step = ((SAMPLE_S[usize::from(!hangs)] / measured.dt).round() as usize).max(1);
        let weights = Arc::new(weights(2 * step));
        let mut start = range.start + MARGIN;
        while start + 2 * step + MARGIN < range.end {
            let rows = start..start + 2 * step;
            start += step;
            let regime = measured.regime[rows.start];
            if regime == Regime::Move || measured.regime[rows.end] != regime {
                continue;
            }
            if let Some(mut sample) = sample(measured, rows, regime, &weights) {
                let stands = regime == Regime::Stand;
                if stands && !sample.set_feet(measured, robot, &structure, &bodies) {
                    continue;
                }
                samples.push(sample);
            }
        }
    }
    samples
}

/// Rows that the derivatives of a sample need before and after it.
const MARGIN: usize = 12;

/// Returns weights of rows that begin and end smoothly, so that derivatives of the mean are differences of the weights.
fn weights(length: usize) -> Vec<f64> {
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
    known.then_some(Sample { rows, t, regime, response, instrument, weights, base_per_torque: Vec::new() })
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
    let gyro = [0, 1, 2].map(|index| axis(&base.gyro, index));
    let into_base = |world: [f64; 3]| {
        let [w, x, y, z] = orientations[0];
        (DQuat::from_xyzw(x, y, z, w).normalize().inverse() * DVec3::from_array(world)).to_array()
    };
    let of_velocity =
        (!base.velocity.is_empty()).then(|| into_base([0, 1, 2].map(|index| axis(&base.velocity, index)[1])));
    // The accelerometer is less noisy than a derivative, and has gravity in it. The columns have the acceleration of the other sensor,
    // whose noise is independent, or that of gravity alone.
    let [linear_acceleration, of_columns] = if base.acceleration.is_empty() {
        [of_velocity?, [0.0; 3]]
    } else {
        let up = into_base([0.0, 0.0, GRAVITY]);
        let felt = [0, 1, 2].map(|index| axis(&base.acceleration, index)[0] - up[index]);
        [felt, of_velocity.unwrap_or([0.0; 3])]
    };
    let angular_velocity = gyro.map(|of| of[0]);
    let response =
        BaseMotion { angular_velocity, angular_acceleration: gyro.map(|of| of[1]), linear_acceleration, ..turned[0] };
    let instrument = BaseMotion { angular_velocity, linear_acceleration: of_columns, ..turned[1] };
    let numbers = response.angular_velocity.iter().chain(&response.angular_acceleration);
    numbers.chain(&response.linear_acceleration).copied().all(f64::is_finite).then_some([response, instrument])
}

impl Sample {
    /// Computes the force at the base per torque of a joint. Returns false if not all feet stand at the end of three joints.
    fn set_feet(
        &mut self,
        measured: &Measurements,
        robot: &Robot,
        structure: &TreeStructure,
        bodies: &TreeParameters<f64>,
    ) -> bool {
        let in_contact = |foot: usize| {
            measured.contact.get(foot).is_none_or(|rows| rows[self.rows.clone()].iter().all(|touches| *touches))
        };
        if robot.feet.is_empty() || !(0..robot.feet.len()).all(in_contact) {
            return false;
        }
        let state = self.state(robot, &self.response, [0.0; 3]);
        let mut places = TreeMotion::empty(bodies);
        places.set(bodies, &state, GRAVITY);
        let turns = twinstep_dynamics::tree::batch_from_bodies(&robot.tree);
        self.base_per_torque = vec![[0.0; 6]; robot.joints.len()];
        for foot in &robot.feet {
            let branch = &structure.branches[foot.body];
            if branch.len() != 3 {
                return false;
            }
            let place = &places.bodies[foot.body].place;
            let centre = Vec3((turns[foot.body] * foot.centre).to_array());
            let down = state.world_axes()[2].scaled(-foot.radius);
            let contact = place.origin + place.turned(centre) + down;
            let column = |joint: &usize| {
                let axis = &places.bodies[joint + 1].axis;
                DVec3::from_array((axis.linear + axis.angular.cross(contact)).0)
            };
            let [a, b, c] = [0, 1, 2].map(|index| column(&branch[index]));
            // Jᵀ f = τ.
            let jacobian = DMat3::from_cols(a, b, c);
            if jacobian.determinant().abs() < 1e-4 {
                return false;
            }
            let force_per_torque = jacobian.transpose().inverse();
            for (index, joint) in branch.iter().enumerate() {
                let force = force_per_torque.col(index);
                let moment = DVec3::from_array(contact.0).cross(force);
                self.base_per_torque[*joint] = [moment.x, moment.y, moment.z, force.x, force.y, force.z];
            }
        }
        true
    }
}
