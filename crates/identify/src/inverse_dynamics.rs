//! The torques of a measured motion: what a model's actuators give for it, and what its bodies need.
//!
//! No simulation, and so no error that adds up: what is left over stands beside the speed, position or acceleration
//! that explains it.

use std::ops::Range;

use twinstep_model::{dynamics::{Acceleration, SimdCommands, SimdActuators, State, KinematicTree, Vec3, inverse_dynamics}, BaseMount, NUM_JOINTS, RobotModel};
use twinstep_logs::{Log, TorqueSensor};

use crate::operating_conditions::OperatingConditions;
use crate::motion::{ActuatorClock, JointCommands, MotionError, command, joint_commands};

/// [m/s²]
const GRAVITY: f64 = 9.81;
/// Rows on either side that a slope is taken over.
const HALF_WINDOW: usize = 3;

/// One number a row for each joint, in the order of [`twinstep_model::Joint::ALL`]; NaN where the log cannot tell, and
/// nothing at all for a joint that it lacks.
pub type JointSeries = [Vec<f64>; NUM_JOINTS];

/// Measured motion of the joints, each row at the middle between it and the next, where the mean torque belongs.
#[derive(Clone, Debug)]
pub struct JointTrajectory {
    /// [rad]
    pub q: JointSeries,
    /// Measured, or else the slope of the position [rad/s].
    pub dq: JointSeries,
    /// Slope of the velocity [rad/s²].
    pub ddq: JointSeries,
}

/// What measured motion leaves over under a model.
#[derive(Clone, Debug)]
pub struct InverseDynamicsResidual {
    /// What motor, friction and spring of the model give, less what its bodies need for the measured motion [N·m]; of a
    /// trunk that is held, because the ground's forces are not measured.
    pub torque: JointSeries,
    /// Torque that the model's actuators would show at the log's sensor [N·m].
    pub estimated_torque: JointSeries,
}

impl JointTrajectory {
    /// Those of `log`.
    pub fn of(log: &Log) -> Result<Self, MotionError> {
        let mut this = Self { q: empty(), dq: empty(), ddq: empty() };
        for joint in joint_commands(log)? {
            let (index, name) = (joint.joint.index(), joint.joint.name());
            let q = log.q(name).unwrap_or_default();
            let dq = log.dq(name).map_or_else(|| derivative(log, q), <[f64]>::to_vec);
            this.ddq[index] = midpoints(log, &derivative(log, &dq));
            this.dq[index] = midpoints(log, &dq);
            this.q[index] = midpoints(log, q);
        }
        Ok(this)
    }
}

impl InverseDynamicsResidual {
    /// That of `robot` on `log`.
    pub fn of(log: &Log, robot: &RobotModel) -> Result<Self, MotionError> {
        let (joints, clock) = (joint_commands(log)?, ActuatorClock::of(log, robot)?);
        let kinematics = JointTrajectory::of(log)?;
        let mut robot = robot.clone();
        for joint in &mut robot.joints {
            // The encoder follows the rotor: play and springs in the gear are in the measured position already.
            (joint.actuator.backlash, joint.actuator.gear_stiffness) = (0.0, f64::INFINITY);
        }
        let player = ActuatorReplay { log, robot: &robot, joints, clock, kinematics };
        let mut balance = Self { torque: empty(), estimated_torque: empty() };
        for joint in &player.joints {
            balance.torque[joint.joint.index()] = vec![f64::NAN; log.rows()];
            balance.estimated_torque[joint.joint.index()] = vec![f64::NAN; log.rows()];
        }
        for (segment, rows) in log.segments().filter(|(_, rows)| rows.len() > 1) {
            player.play(rows, segment.base == BaseMount::Fixed, &mut balance);
        }
        Ok(balance)
    }
}

/// A log whose commands go through a model's actuators.
struct ActuatorReplay<'a> {
    log: &'a Log,
    robot: &'a RobotModel,
    joints: Vec<JointCommands<'a>>,
    clock: ActuatorClock,
    kinematics: JointTrajectory,
}

impl ActuatorReplay<'_> {
    fn play(&self, rows: Range<usize>, held: bool, balance: &mut InverseDynamicsResidual) {
        let (robot, t) = (self.robot, &self.log.t()[rows.clone()]);
        let (conditions, tree) = (OperatingConditions::of(self.log), KinematicTree::splat(robot));
        let mut actuator = SimdActuators::<f64>::new(robot, robot.control.actuator_dt());
        actuator.set(0, robot, &self.sampled(rows.start).0.map(|q| q as f32), &[0.0; NUM_JOINTS]);
        for row in rows.start..rows.end - 1 {
            let mut command = command(robot, &self.joints, row);
            command.derating_factor = conditions.derating_factors(&robot.derating, row);
            let commands = SimdCommands::new(&[command]);
            let (q, dq) = self.sampled(row);
            let middle = self.middle(row);
            let needed = inverse_dynamics(&tree, &middle.0, &middle.1, GRAVITY).1;
            let periods = self.clock.periods_between(t, row - rows.start).max(1);
            let (mut given, mut shown) = ([0.0; NUM_JOINTS], [0.0; NUM_JOINTS]);
            for _ in 0..periods {
                actuator.update_command(&commands, &q, &dq);
                let forces = actuator.step(0, &middle.0.q, &middle.0.dq);
                for joint in 0..NUM_JOINTS {
                    let speed = middle.0.dq[joint];
                    let friction = forces.damping[joint] * speed + forces.dry_friction[joint] * (speed / 0.02).tanh();
                    let spring = robot.joints[joint].spring;
                    let spring = spring.torque_offset - spring.stiffness * middle.0.q[joint];
                    given[joint] += (forces.tau[joint] - friction) / periods as f64;
                    shown[joint] += match self.log.meta().tau_sensor {
                        TorqueSensor::JointOutput => {
                            let rotor = robot.joints[joint].armature * middle.1.ddq[joint];
                            forces.tau[joint] - spring - friction - rotor
                        }
                        _ => actuator.estimated_torque()[joint],
                    } / periods as f64;
                }
            }
            for joint in self.joints.iter().map(|joint| joint.joint.index()) {
                balance.estimated_torque[joint][row] = shown[joint];
                if held && self.kinematics.ddq[joint][row].is_finite() {
                    balance.torque[joint][row] = given[joint] - needed[joint];
                }
            }
        }
    }

    /// What the actuator is given in `row`, which is not the last: it adds its offset, which a log has already.
    fn sampled(&self, row: usize) -> ([f64; NUM_JOINTS], [f64; NUM_JOINTS]) {
        let (mut q, mut dq) = (self.robot.control.default_pose, [0.0; NUM_JOINTS]);
        for joint in &self.joints {
            let (index, name) = (joint.joint.index(), joint.joint.name());
            q[index] = self.log.q(name).map_or(q[index], |q| q[row]) - self.robot.joints[index].actuator.encoder_offset;
            let measured = self.log.dq(name).map(|dq| dq[row]).filter(|dq| dq.is_finite());
            let back = 0.5 * (self.log.t()[row + 1] - self.log.t()[row]);
            let slope = || self.kinematics.dq[index][row] - back * self.kinematics.ddq[index][row];
            dq[index] = measured.unwrap_or_else(|| or_zero(slope()));
        }
        (q, dq)
    }

    /// The measured motion between `row` and the next; a joint that nobody measured holds still.
    fn middle(&self, row: usize) -> (State<f64>, Acceleration<f64>) {
        let mut state = State::<f64>::origin();
        let mut ddq = [0.0; NUM_JOINTS];
        state.q = self.robot.control.default_pose;
        for joint in self.joints.iter().map(|joint| joint.joint.index()) {
            let offset = self.robot.joints[joint].actuator.encoder_offset;
            state.q[joint] = or_zero(self.kinematics.q[joint][row] - offset);
            state.dq[joint] = or_zero(self.kinematics.dq[joint][row]);
            ddq[joint] = or_zero(self.kinematics.ddq[joint][row]);
        }
        (state, Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq })
    }
}

fn empty() -> JointSeries {
    [const { Vec::new() }; NUM_JOINTS]
}

fn or_zero(value: f64) -> f64 {
    if value.is_finite() { value } else { 0.0 }
}

/// Change of `cells` with time, by row: that of the parabola through the row and three on either side. NaN near
/// the ends of the log's parts.
fn derivative(log: &Log, cells: &[f64]) -> Vec<f64> {
    let slope = |row: usize| {
        let near = || row - HALF_WINDOW..=row + HALF_WINDOW;
        let dt = |other: usize| log.t()[other] - log.t()[row];
        let middle = near().map(dt).sum::<f64>() / near().count() as f64;
        let spread: f64 = near().map(|other| (dt(other) - middle).powi(2)).sum();
        near().map(|other| (dt(other) - middle) * cells[other]).sum::<f64>() / spread
    };
    let mut slopes = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        (rows.start + HALF_WINDOW..rows.end.saturating_sub(HALF_WINDOW)).for_each(|row| slopes[row] = slope(row));
    }
    slopes
}

/// Means of neighbouring rows of a part; its last has none.
fn midpoints(log: &Log, cells: &[f64]) -> Vec<f64> {
    let mut means = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        (rows.start..rows.end - 1).for_each(|row| means[row] = f64::midpoint(cells[row], cells[row + 1]));
    }
    means
}
