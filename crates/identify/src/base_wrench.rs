//! Wrench on the base of a standing robot that the model needs and the feet do not exert, from measured states.
//!
//! The equations of motion of a leg give the force on its foot from the measured torques, and those of the base must
//! balance with these forces. Nothing is simulated and contact needs no model, so the residual shows masses and centres
//! of mass to a few millimetres, which positions of a standing robot do not.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::dynamics::{
    Acceleration, KinematicTree, LegFrames, SimdActuators, State, Vec3, Wrench, inverse_dynamics,
};
use twinstep_model::{ActuatorParams, BaseMount, JOINT_NAMES, NUM_JOINTS, RobotModel};

use crate::orientation::orientation;

/// Gravitational acceleration [m/s²].
const GRAVITY: f64 = 9.81;
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
    state: State<f64>,
    acceleration: Acceleration<f64>,
    /// Torques at the motors [N·m].
    torque: [f64; NUM_JOINTS],
}

impl MeasuredStance {
    /// Collects the samples of `log` in which a robot like `robot` stands.
    ///
    /// There are none if the log lacks motor currents, joint velocities, angular velocity or orientation.
    pub fn new(log: &Log, robot: &RobotModel) -> Self {
        let half = ((SAMPLE_S * log.meta().rate_hz).round() as usize).max(1);
        let none = Self { samples: Vec::new(), rows_per_sample: half };
        if log.meta().tau_sensor != TorqueSensor::MotorCurrent {
            return none;
        }
        let Some(channels) = StanceChannels::of(log) else { return none };
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
        let mut actuators = SimdActuators::<f64>::new(&robot, robot.control.actuator_dt());
        actuators.set(0, &robot, &robot.control.default_pose.map(|q| q as f32), &[0.0; NUM_JOINTS]);
        self.samples.iter().map(|sample| sample.error(&robot, &tree, &mut actuators, torque_errors)).collect()
    }
}

impl StanceSample {
    fn error(
        &self,
        robot: &RobotModel,
        tree: &KinematicTree<f64>,
        actuators: &mut SimdActuators<f64>,
        torque_errors: &[f64; NUM_JOINTS],
    ) -> [f64; 6] {
        let mut state = self.state;
        for (q, joint) in state.q.iter_mut().zip(&robot.joints) {
            *q -= joint.actuator.encoder_offset;
        }
        state.angular_velocity = state.angular_velocity - Vec3::splat(robot.gyro_bias);
        actuators.set_torque(std::array::from_fn(|joint| self.torque[joint] + torque_errors[joint]));
        let forces = actuators.step(0, &state.q, &state.dq);
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
    /// Velocity in the world frame; without it the base is taken as not accelerated.
    velocity: Option<[&'a [f64]; 3]>,
}

impl<'a> StanceChannels<'a> {
    fn of(log: &'a Log) -> Option<Self> {
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
            velocity: axes("vel"),
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
        let in_base = |velocity: [&[f64]; 3]| rotation.inverse() * DVec3::from_array(velocity.map(slope));
        let state = State {
            orientation: [rotation.w, rotation.x, rotation.y, rotation.z],
            angular_velocity: Vec3(self.gyro.map(mean)),
            q: self.q.map(mean),
            dq: self.dq.map(mean),
            ..State::origin()
        };
        let acceleration = Acceleration {
            angular: Vec3(self.gyro.map(slope)),
            linear: Vec3(self.velocity.map_or(DVec3::ZERO, in_base).to_array()),
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use twinstep_logs::{Meta, Segment};
    use twinstep_model::{Precision, RobotStates, Rollout, RolloutRequest, go2};

    use super::*;
    use crate::experiment::{Experiment, ResidualChannel};
    use crate::window::WindowConfig;

    const POSE: [f64; 3] = [0.1, 0.8, -1.5];

    /// Returns a log of 1 s in which `robot` stands still on four feet, with the torques that hold it.
    ///
    /// Force and moment of the ground are divided over the feet by the least squares of their norm.
    fn standing(robot: &RobotModel, pose: [f64; 3], sensor: TorqueSensor, base: BaseMount) -> Log {
        let mut state = State::origin();
        state.q = std::array::from_fn(|joint| if joint % 6 == 3 { -pose[0] } else { pose[joint % 3] });
        let rest = Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq: [0.0; NUM_JOINTS] };
        let tree = KinematicTree::splat(robot);
        let (Wrench { force, moment }, mut tau) = inverse_dynamics(&tree, &state, &rest, GRAVITY);
        let frames: [LegFrames<f64>; 4] = std::array::from_fn(|leg| LegFrames::new(&tree, &state.q, leg));
        let contact = |leg: usize| {
            let centre = frames[leg].calf_point(Vec3::splat(robot.shapes.foot_centre));
            centre - Vec3([0.0, 0.0, robot.shapes.foot_radius])
        };
        // f = W⁺ (force, moment), where W stacks the wrenches of unit forces.
        let map = nalgebra::DMatrix::from_fn(6, 12, |row, column| {
            let (leg, axis) = (column / 3, column % 3);
            let unit = Vec3(std::array::from_fn(|other| if other == axis { 1.0 } else { 0.0 }));
            if row < 3 { unit.0[row] } else { contact(leg).cross(unit).0[row - 3] }
        });
        let needed = nalgebra::DVector::from_iterator(6, force.0.into_iter().chain(moment.0));
        let on_feet = map.pseudo_inverse(1e-9).expect("of full rank") * needed;
        for (joint, tau) in tau.iter_mut().enumerate() {
            let leg = joint / 3;
            let on_foot = Vec3([on_feet[3 * leg], on_feet[3 * leg + 1], on_feet[3 * leg + 2]]);
            *tau -= frames[leg].calf_jacobian(contact(leg))[joint % 3].dot(on_foot);
        }
        log(&state.q, &tau, sensor, base)
    }

    fn log(q: &[f64; NUM_JOINTS], tau: &[f64; NUM_JOINTS], sensor: TorqueSensor, base: BaseMount) -> Log {
        let constant = |name: &str, value: f64| (name.to_owned(), vec![value; 200]);
        let mut columns = vec![("t".to_owned(), (0..200).map(|row| f64::from(row) / 200.0).collect())];
        let zeros =
            ["gyro", "vel", "pos"].into_iter().flat_map(|kind| ["x", "y", "z"].map(|axis| format!("{kind}_{axis}")));
        columns.extend(zeros.chain(["quat_x", "quat_y", "quat_z"].map(str::to_owned)).map(|name| constant(&name, 0.0)));
        columns.extend([constant("quat_w", 1.0), constant("kp", 30.0), constant("kd", 1.0)]);
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            columns.push(constant(&format!("q_{name}"), q[joint]));
            columns.push(constant(&format!("q_cmd_{name}"), q[joint]));
            columns.push(constant(&format!("dq_{name}"), 0.0));
            columns.push(constant(&format!("tau_measured_{name}"), tau[joint]));
        }
        let segments = vec![Segment { name: "stand".to_owned(), base }];
        Log::new(Meta::new(200.0, sensor, segments), columns).expect("a log")
    }

    /// Returns the error of `model` on a log of `robot`, mean over all samples.
    fn error(robot: &RobotModel, model: &RobotModel) -> [f64; 6] {
        let log = standing(robot, POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
        let errors = MeasuredStance::new(&log, model).errors(model, &[0.0; NUM_JOINTS]);
        assert!(!errors.is_empty());
        std::array::from_fn(|axis| errors.iter().map(|error| error[axis]).sum::<f64>() / errors.len() as f64)
    }

    #[test]
    fn right_model_is_in_balance() {
        let left = error(&go2(), &go2());
        assert!(left.iter().all(|error| error.abs() < 1e-6), "{left:?}");
    }

    #[test]
    fn payload_is_missing_as_its_weight() {
        let [force, moment] = [[0.0, 0.0, -2.0 * GRAVITY], [0.0, 2.0 * GRAVITY * 0.1, 0.0]];
        let mut loaded = go2();
        loaded.trunk = loaded.trunk.with_point_mass(2.0, DVec3::new(0.1, 0.0, 0.0));
        let left = error(&loaded, &go2());
        for (left, expected) in left.iter().zip(force.into_iter().chain(moment)) {
            assert!((left - expected).abs() < 1e-6, "{left} for {expected}");
        }
    }

    #[test]
    fn gain_of_a_motor_is_applied_to_its_current() {
        let mut weak = go2();
        weak.joints[2].actuator.gain = 0.5;
        let log = standing(&go2(), POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
        let left = MeasuredStance::new(&log, &weak).errors(&weak, &[0.0; NUM_JOINTS])[0];
        assert!(left[2] > 5.0, "half of the torque of a calf lifts less: {left:?}");
    }

    #[test]
    fn only_standing_robots_with_current_sensors_have_samples() {
        let samples =
            |pose, sensor, base| MeasuredStance::new(&standing(&go2(), pose, sensor, base), &go2()).samples.len();
        assert!(samples(POSE, TorqueSensor::MotorCurrent, BaseMount::Floating) > 10);
        assert_eq!(samples(POSE, TorqueSensor::JointOutput, BaseMount::Floating), 0);
        assert_eq!(samples(POSE, TorqueSensor::MotorCurrent, BaseMount::Fixed), 0);
        let lying = [0.1, 1.4, -2.7];
        assert_eq!(samples(lying, TorqueSensor::MotorCurrent, BaseMount::Floating), 0, "the trunk carries it");
    }

    /// A simulator whose robots do not move.
    struct Standstill;

    impl Rollout for Standstill {
        fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
            jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect()
        }
    }

    /// Returns the vertical force that `robot` lacks, by row, if `log` is an experiment [noise std].
    fn vertical_residuals(log: &Log, robot: &RobotModel) -> Vec<f64> {
        let experiment = Experiment::new(log, &go2(), WindowConfig::DIAGNOSIS).expect("an experiment");
        let residuals = experiment.residuals(&mut Standstill, std::slice::from_ref(robot), Precision::Double).remove(0);
        let cells = experiment.residual_index().zip(residuals);
        cells
            .filter(|((channel, _), _)| *channel == ResidualChannel::BaseWrench(2))
            .map(|(_, residual)| residual)
            .collect()
    }

    #[test]
    fn residuals_of_an_experiment_have_the_wrench_where_the_robot_does_not_walk() {
        let log = standing(&go2(), POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
        let mut loaded = go2();
        loaded.trunk = loaded.trunk.with_point_mass(2.0, DVec3::ZERO);
        let residuals = vertical_residuals(&log, &loaded);
        assert!(residuals.len() > 100, "{}", residuals.len());
        assert!(residuals.iter().all(|residual| (residual - 2.0 * GRAVITY).abs() < 1e-6), "of 1 N");
        let mut trotting: Vec<_> = log.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
        for (name, cells) in trotting.iter_mut().filter(|(name, _)| name.starts_with("q_")) {
            let swing = |row: usize| 0.2 * (std::f64::consts::TAU * 2.0 * row as f64 / 200.0).sin();
            let at_rest = !name.contains("cmd");
            cells.iter_mut().enumerate().filter(|_| at_rest).for_each(|(row, cell)| *cell += swing(row));
        }
        trotting.push(("t".to_owned(), log.t().to_vec()));
        let trotting = Log::new(log.meta().clone(), trotting).expect("a log");
        assert!(vertical_residuals(&trotting, &loaded).is_empty());
    }

    #[test]
    fn rows_until_the_next_sample_belong_to_a_sample() {
        let log = standing(&go2(), POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
        let stance = MeasuredStance::new(&log, &go2());
        let rows: Vec<usize> = stance.rows().collect();
        assert_eq!((rows[0], stance.sample_of(rows[0]), stance.sample_of(rows[0] - 1)), (20, Some(0), None));
        assert_eq!(stance.sample_of(rows[rows.len() - 1] + 1), None);
        assert!(rows.iter().all(|row| stance.sample_of(*row) == Some((row - 20) / 10)));
    }

    #[test]
    fn mean_needs_half_of_the_cells() {
        let cells = [1.0, f64::NAN, 3.0, f64::NAN, f64::NAN];
        assert_eq!(mean_around(&cells, 1, 1), 2.0);
        assert!(mean_around(&cells, 3, 1).is_nan());
    }

    proptest! {
        /// A moment m g × d, whatever the pose.
        #[test]
        fn shifted_centre_of_mass_is_missing_as_a_moment(x in -0.05..0.05f64, y in -0.05..0.05f64, z in -0.05..0.05f64) {
            let (mut shifted, mass) = (go2(), go2().trunk.mass);
            shifted.trunk.com += DVec3::new(x, y, z);
            let left = error(&shifted, &go2());
            let expected = [0.0, 0.0, 0.0, -mass * GRAVITY * y, mass * GRAVITY * x, 0.0];
            for (left, expected) in left.iter().zip(expected) {
                prop_assert!((left - expected).abs() < 1e-6, "{left} for {expected}");
            }
        }
    }
}
