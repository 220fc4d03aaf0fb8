//! Wrench on the base of a standing robot that the model needs and the feet do not exert, from measured states.
//!
//! The equations of motion of a leg give the force on its foot from the measured torques, and those of the base must
//! balance with these forces. Nothing is simulated and contact needs no model, so the residual shows masses and centres
//! of mass to a few millimetres, which positions of a standing robot do not.

#[cfg(test)]
mod tests;

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};
use twinstep_dynamics::quadruped::{Acceleration, KinematicTree, LegFrames, QuadrupedState, Wrench, inverse_dynamics};
use twinstep_dynamics::{SimdActuators, Vec3};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{ActuatorParams, BaseMount, JOINT_NAMES, NUM_JOINTS, RobotModel};

use crate::base_estimate::BaseEstimate;
use crate::inverse_dynamics::GRAVITY;
use crate::orientation::orientation;

/// Time between samples, and half of the time over which measurements are averaged [s].
const SAMPLE_S: f64 = 0.05;
/// Least mean height of the base above the feet [m]: a robot that lies is carried by its trunk.
const LEAST_HEIGHT_M: f64 = 0.15;
/// Velocity below which dry friction is less than its maximum, because measured velocities are noisy [rad/s].
const SLIDING_SPEED: f64 = 0.02;

/// Measured states and torques of a robot with a floating base, averaged over [`SAMPLE_S`] before and after each sample.
///
/// A sample stands for the rows until the next, [`SAMPLE_S`] later.
#[derive(Clone, Debug)]
pub struct MeasuredStance {
    samples: Vec<StanceSample>,
    /// Number of rows of a sample.
    rows_per_sample: usize,
}

#[derive(Clone, Debug)]
struct StanceSample {
    row: usize,
    state: QuadrupedState<f64>,
    acceleration: Acceleration<f64>,
    /// Torques at the motors [N·m].
    torque: [f64; NUM_JOINTS],
}

impl MeasuredStance {
    /// Collects the samples of `log` in which a robot like `robot` stands.
    ///
    /// `estimate` has the velocity of the base if it was not measured. There are no samples if the log lacks motor
    /// currents, joint velocities, angular velocity or orientation.
    pub fn new(log: &Log, robot: &RobotModel, estimate: Option<&BaseEstimate>) -> Self {
        let half = ((SAMPLE_S * log.meta().rate_hz).round() as usize).max(1);
        let none = Self { samples: Vec::new(), rows_per_sample: half };
        if log.meta().tau_sensor != TorqueSensor::MotorCurrent {
            return none;
        }
        let estimated =
            estimate.map(|estimate| [0, 1, 2].map(|axis| estimate.velocity.iter().map(|all| all[axis]).collect()));
        let Some(channels) = StanceChannels::of(log, estimated.as_ref()) else { return none };
        let floating = log.segments().filter(|(segment, _)| segment.base == BaseMount::Floating);
        let rows =
            floating.flat_map(|(_, rows)| (rows.start + 2 * half..rows.end.saturating_sub(2 * half)).step_by(half));
        let samples = rows.filter_map(|row| channels.sample(log, row, half));
        Self { samples: samples.filter(|sample| sample.height(robot) > LEAST_HEIGHT_M).collect(), ..none }
    }

    /// Returns the rows of all samples, in ascending order.
    pub fn rows(&self) -> impl Iterator<Item = usize> {
        self.samples.iter().flat_map(|sample| sample.row..sample.row + self.rows_per_sample)
    }

    /// Returns the number of the sample that stands for a row.
    pub fn sample_of(&self, row: usize) -> Option<usize> {
        let next = self.samples.partition_point(|sample| sample.row <= row);
        next.checked_sub(1).filter(|sample| row < self.samples[*sample].row + self.rows_per_sample)
    }

    /// Returns force [N] and moment [N·m] at the base's origin in base axes for each sample: inverse dynamics of `robot`
    /// minus the forces on its feet.
    ///
    /// `torque_errors` [N·m] are added to the measured torques.
    pub fn errors(&self, robot: &RobotModel, torque_errors: &[f64; NUM_JOINTS]) -> Vec<[f64; 6]> {
        let mut robot = robot.clone();
        for joint in &mut robot.joints {
            // What acts before the current sensor is in the measured torque.
            let ActuatorParams { gain, ripple, encoder_offset, .. } = joint.actuator;
            joint.actuator = ActuatorParams { gain, ripple, encoder_offset, ..ActuatorParams::IDEAL };
        }
        let tree = KinematicTree::splat(&robot);
        let mut actuators = SimdActuators::new(&robot.joints, robot.control.actuator_dt(), robot.control.actuator_dt());
        actuators.set(0, &robot.joints, &robot.control.default_pose, &[0.0; NUM_JOINTS]);
        self.samples.iter().map(|sample| sample.error(&robot, &tree, &mut actuators, torque_errors)).collect()
    }
}

impl StanceSample {
    fn error(
        &self,
        robot: &RobotModel,
        tree: &KinematicTree<f64>,
        actuators: &mut SimdActuators<f64, [f64; NUM_JOINTS]>,
        torque_errors: &[f64; NUM_JOINTS],
    ) -> [f64; 6] {
        let mut state = self.state;
        for (q, joint) in state.q.iter_mut().zip(&robot.joints) {
            *q -= joint.actuator.encoder_offset;
        }
        state.angular_velocity = state.angular_velocity - Vec3::splat(robot.gyro_bias);
        actuators.set_torque(&std::array::from_fn(|joint| self.torque[joint] + torque_errors[joint]));
        actuators.step(0, &state.q, &state.dq);
        let forces = actuators.forces();
        let (Wrench { mut force, mut moment }, needed) = inverse_dynamics(tree, &state, &self.acceleration, GRAVITY);
        let down = state.world_axes()[2].scaled(-robot.shapes.foot_radius);
        for leg in 0..4 {
            let frames = LegFrames::new(tree, &state.q, leg);
            let contact = frames.calf_point(Vec3::splat(robot.shapes.foot_centre)) + down;
            let columns = frames.calf_jacobian(contact).map(|column| DVec3::from_array(column.0));
            let lacking = DVec3::from_array(std::array::from_fn(|joint| {
                let (index, speed) = (3 * leg + joint, state.dq[3 * leg + joint]);
                let friction =
                    forces.damping[index] * speed + forces.dry_friction[index] * (speed / SLIDING_SPEED).tanh();
                needed[index] - (forces.tau[index] - friction)
            }));
            // Jᵀ f = inverse dynamics − torque of the actuator.
            let on_foot =
                DMat3::from_cols_array_2d(&columns.map(|column| column.to_array())).transpose().inverse() * lacking;
            let on_foot = Vec3(on_foot.to_array());
            (force, moment) = (force - on_foot, moment - contact.cross(on_foot));
        }
        let ([fx, fy, fz], [mx, my, mz]) = (force.0, moment.0);
        [fx, fy, fz, mx, my, mz]
    }

    /// Returns the mean height of the base above the centres of the feet [m].
    fn height(&self, robot: &RobotModel) -> f64 {
        let (tree, up) = (KinematicTree::splat(robot), self.state.world_axes()[2]);
        let depth =
            |leg| -up.dot(LegFrames::new(&tree, &self.state.q, leg).calf_point(Vec3::splat(robot.shapes.foot_centre)));
        (0..4).map(depth).sum::<f64>() / 4.0
    }
}

/// Channels of a log from which the samples are averaged.
struct StanceChannels<'a> {
    q: [&'a [f64]; NUM_JOINTS],
    dq: [&'a [f64]; NUM_JOINTS],
    torque: [&'a [f64]; NUM_JOINTS],
    gyro: [&'a [f64]; 3],
    /// Velocity in the world frame.
    velocity: [&'a [f64]; 3],
}

impl<'a> StanceChannels<'a> {
    fn of(log: &'a Log, estimated_velocity: Option<&'a [Vec<f64>; 3]>) -> Option<Self> {
        let axes = |kind: &str| {
            let [x, y, z] = ["x", "y", "z"].map(|axis| log.channel(&format!("{kind}_{axis}")));
            Some([x?, y?, z?])
        };
        let joints = |of: &dyn Fn(&str) -> Option<&'a [f64]>| {
            let columns: Option<Vec<&[f64]>> = JOINT_NAMES.iter().map(|name| of(name)).collect();
            columns.and_then(|columns| columns.try_into().ok())
        };
        log.channel("quat_w")?;
        Some(Self {
            q: joints(&|name| log.q(name))?,
            dq: joints(&|name| log.dq(name))?,
            torque: joints(&|name| log.tau_measured(name))?,
            gyro: axes("gyro")?,
            velocity: estimated_velocity.map(|axes| axes.each_ref().map(Vec::as_slice)).or_else(|| axes("vel"))?,
        })
    }

    /// Returns the sample at `row`; `None` if cells around it are missing.
    fn sample(&self, log: &Log, row: usize, half: usize) -> Option<StanceSample> {
        let mean = |cells: &[f64]| mean_around(cells, row, half);
        let slope = |cells: &[f64]| {
            let time = log.t()[row + half] - log.t()[row - half];
            (mean_around(cells, row + half, half) - mean_around(cells, row - half, half)) / time
        };
        let rotation = mean_rotation(log, row - half..row + half + 1)?;
        let state = QuadrupedState {
            orientation: [rotation.w, rotation.x, rotation.y, rotation.z],
            angular_velocity: Vec3(self.gyro.map(mean)),
            q: self.q.map(mean),
            dq: self.dq.map(mean),
            ..QuadrupedState::origin(NUM_JOINTS)
        };
        let acceleration = Acceleration {
            angular: Vec3(self.gyro.map(slope)),
            linear: Vec3((rotation.inverse() * DVec3::from_array(self.velocity.map(slope))).to_array()),
            ddq: self.dq.map(slope),
        };
        let torque = self.torque.map(mean);
        let known = state.q.iter().chain(&torque).chain(&acceleration.ddq).chain(&acceleration.angular.0);
        let known = known.chain(&acceleration.linear.0);
        known.copied().all(f64::is_finite).then_some(StanceSample { row, state, acceleration, torque })
    }
}

/// Returns the mean of the measured cells in the rows up to `half` before and after `row`; NaN if half of them are missing.
fn mean_around(cells: &[f64], row: usize, half: usize) -> f64 {
    let near = &cells[row - half..=row + half];
    let (sum, count) =
        near.iter().filter(|cell| cell.is_finite()).fold((0.0, 0.0), |(sum, n), cell| (sum + cell, n + 1.0));
    if 2.0 * count > near.len() as f64 { sum / count } else { f64::NAN }
}

/// Returns the mean of the measured orientations, which differ little; `None` if there are none.
fn mean_rotation(log: &Log, rows: Range<usize>) -> Option<DQuat> {
    let w = log.channel("quat_w")?;
    let measured = rows.filter(|row| w[*row].is_finite()).map(|row| orientation(log, row));
    let sum = measured.reduce(|sum, one| if sum.dot(one) < 0.0 { sum - one } else { sum + one });
    sum.map(DQuat::normalize)
}
