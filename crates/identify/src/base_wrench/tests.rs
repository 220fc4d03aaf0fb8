//! Robots that stand still, with the torques that hold them.

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
    let mut state = QuadrupedState::origin(12);
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
    let errors = MeasuredStance::new(&log, model, None).errors(model, &[0.0; NUM_JOINTS]);
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
    let left = MeasuredStance::new(&log, &weak, None).errors(&weak, &[0.0; NUM_JOINTS])[0];
    assert!(left[2] > 5.0, "half of the torque of a calf lifts less: {left:?}");
}

#[test]
fn only_standing_robots_with_current_sensors_have_samples() {
    let samples =
        |pose, sensor, base| MeasuredStance::new(&standing(&go2(), pose, sensor, base), &go2(), None).samples.len();
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
    cells.filter(|((channel, _), _)| *channel == ResidualChannel::BaseWrench(2)).map(|(_, residual)| residual).collect()
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

/// Without motion capture the velocity is estimated from legs and IMU.
#[test]
fn wrench_needs_no_motion_capture() {
    let log = standing(&go2(), POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
    let columns = log.channels().filter(|(name, _)| !name.starts_with("vel_") && !name.starts_with("pos_"));
    let mut columns: Vec<_> = columns.map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
    columns.push(("t".to_owned(), log.t().to_vec()));
    let log = Log::new(log.meta().clone(), columns).expect("a log");
    let mut loaded = go2();
    loaded.trunk = loaded.trunk.with_point_mass(2.0, DVec3::ZERO);
    let residuals = vertical_residuals(&log, &loaded);
    assert!(residuals.len() > 100, "{}", residuals.len());
    assert!(residuals.iter().all(|residual| (residual - 2.0 * GRAVITY).abs() < 1.0), "{residuals:?}");
}

#[test]
fn rows_until_the_next_sample_belong_to_a_sample() {
    let log = standing(&go2(), POSE, TorqueSensor::MotorCurrent, BaseMount::Floating);
    let stance = MeasuredStance::new(&log, &go2(), None);
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
