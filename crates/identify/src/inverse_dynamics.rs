//! Inverse-dynamics residual: torque of a model's actuators on measured states minus the torque of the measured motion.
//!
//! Nothing is simulated, so errors do not accumulate. The residual in a row depends on speed, position and acceleration
//! in the same row.

use std::ops::Range;

use twinstep_dynamics::quadruped::{Acceleration, KinematicTree, QuadrupedState, inverse_dynamics};
use twinstep_dynamics::{SimdActuators, SimdCommands, Vec3};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{BaseMount, NUM_JOINTS, RobotModel};

use twinstep_logs::operating_conditions::OperatingConditions;
use twinstep_logs::replay::{
    ActuatorClock, JointCommands, ReplayError, at_log_rate, command, delayed_mean, joint_commands,
};

/// Gravitational acceleration [m/s²].
pub(crate) const GRAVITY: f64 = 9.81;
/// Number of rows on either side for a derivative.
const HALF_WINDOW: usize = 3;

/// One value per row for each joint, in the order of [`twinstep_model::Joint::ALL`].
///
/// Values are NaN if they are not known. The series of a joint that the log lacks is empty.
pub type JointSeries = [Vec<f64>; NUM_JOINTS];

/// Measured motion of the joints at the midpoint of each row and the next, the time of the mean torque.
#[derive(Clone, Debug)]
pub struct JointTrajectory {
    /// Position [rad].
    pub q: JointSeries,
    /// Velocity [rad/s]: measured, or else the derivative of the position.
    pub dq: JointSeries,
    /// Acceleration [rad/s²]: the derivative of the velocity.
    pub ddq: JointSeries,
}

/// Inverse-dynamics residual of a model on a log.
#[derive(Clone, Debug)]
pub struct InverseDynamicsResidual {
    /// Torque of the model's motor, friction and spring, minus inverse dynamics of the measured motion [N·m].
    ///
    /// Only with a fixed base, because contact forces are not measured.
    pub torque: JointSeries,
    /// Torque that the model predicts at the log's torque sensor [N·m].
    pub estimated_torque: JointSeries,
}

impl JointTrajectory {
    /// Computes the trajectory of `log`.
    pub fn of(log: &Log) -> Result<Self, ReplayError> {
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
    /// Computes the residual of `robot` on `log`.
    pub fn of(log: &Log, robot: &RobotModel) -> Result<Self, ReplayError> {
        let mut robot = at_log_rate(log, robot)?;
        let (joints, clock) = (joint_commands(log)?, ActuatorClock::of(log, &robot)?);
        let kinematics = JointTrajectory::of(log)?;
        for joint in &mut robot.joints {
            // The encoder is at the rotor: the measured position contains the effect of backlash and elasticity.
            (joint.actuator.backlash, joint.actuator.gear_stiffness) = (0.0, f64::INFINITY);
        }
        let replay = ActuatorReplay { log, robot: &robot, joints, clock, kinematics };
        let mut residual = Self { torque: empty(), estimated_torque: empty() };
        for joint in &replay.joints {
            residual.torque[joint.joint.index()] = vec![f64::NAN; log.rows()];
            residual.estimated_torque[joint.joint.index()] = vec![f64::NAN; log.rows()];
        }
        for (segment, rows) in log.segments().filter(|(_, rows)| rows.len() > 1) {
            replay.run(rows, segment.base == BaseMount::Fixed, &mut residual);
        }
        Ok(residual)
    }
}

/// Simulation of a model's actuators with the commands of a log.
struct ActuatorReplay<'a> {
    log: &'a Log,
    robot: &'a RobotModel,
    joints: Vec<JointCommands<'a>>,
    clock: ActuatorClock,
    kinematics: JointTrajectory,
}

impl ActuatorReplay<'_> {
    fn run(&self, rows: Range<usize>, is_fixed: bool, residual: &mut InverseDynamicsResidual) {
        let (robot, t) = (self.robot, &self.log.t()[rows.clone()]);
        let (conditions, tree) = (OperatingConditions::of(self.log), KinematicTree::splat(robot));
        let mut actuator = SimdActuators::new(&robot.joints, robot.control.actuator_dt(), robot.control.actuator_dt());
        actuator.set(0, &robot.joints, &self.sampled(rows.start).0, &[0.0; NUM_JOINTS]);
        // Torque at the sensor in each actuator period since the start of the range [N·m].
        let mut history: Vec<[f64; NUM_JOINTS]> = Vec::new();
        for row in rows.start..rows.end - 1 {
            let commands = SimdCommands::new(&[command(robot, &self.joints, row)]);
            actuator.set_derating(0, &conditions.derating_factors(&robot.derating, row));
            let (q, dq) = self.sampled(row);
            let middle = self.middle(row);
            let required = inverse_dynamics(&tree, &middle.0, &middle.1, GRAVITY).1;
            let periods = self.clock.periods_between(t, row - rows.start).max(1);
            let mut applied = [0.0; NUM_JOINTS];
            for _ in 0..periods {
                actuator.update_command(&commands, &q, &dq);
                actuator.step(0, &middle.0.q, &middle.0.dq);
                let forces = actuator.forces();
                let mut estimated = [0.0; NUM_JOINTS];
                for joint in 0..NUM_JOINTS {
                    let speed = middle.0.dq[joint];
                    let friction = forces.damping[joint] * speed + forces.dry_friction[joint] * (speed / 0.02).tanh();
                    let spring = robot.joints[joint].spring;
                    let spring = spring.torque_offset - spring.stiffness * middle.0.q[joint];
                    applied[joint] += (forces.tau[joint] - friction) / periods as f64;
                    estimated[joint] = match self.log.meta().tau_sensor {
                        TorqueSensor::JointOutput => {
                            let rotor = robot.joints[joint].armature * middle.1.ddq[joint];
                            forces.tau[joint] - spring - friction - rotor
                        }
                        _ => actuator.estimated_torque()[joint],
                    };
                }
                history.push(estimated);
            }
            for joint in self.joints.iter().map(|joint| joint.joint.index()) {
                let delay = robot.joints[joint].actuator.sensor_delay / robot.control.actuator_dt();
                let samples = history.len() - periods..history.len();
                residual.estimated_torque[joint][row] = delayed_mean(|sample| history[sample][joint], samples, delay);
                if is_fixed && self.kinematics.ddq[joint][row].is_finite() {
                    residual.torque[joint][row] = applied[joint] - required[joint];
                }
            }
        }
    }

    /// Returns the joint positions [rad] and velocities [rad/s] in `row`, which is not the last one.
    ///
    /// Encoder offsets are subtracted, because the actuators add them.
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

    /// Returns the measured motion at the midpoint of `row` and the next. Joints without measurement are at rest.
    fn middle(&self, row: usize) -> (QuadrupedState<f64>, Acceleration<f64>) {
        let mut state = QuadrupedState::<f64>::origin(NUM_JOINTS);
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

/// Returns the time derivative of `cells` by row: of the parabola fit through the row and [`HALF_WINDOW`] on either
/// side.
///
/// It is NaN near the ends of contiguous ranges of rows.
fn derivative(log: &Log, cells: &[f64]) -> Vec<f64> {
    let slope = |row: usize| {
        let near = || row - HALF_WINDOW..=row + HALF_WINDOW;
        let dt = |other: usize| log.t()[other] - log.t()[row];
        let middle = near().map(dt).sum::<f64>() / near().count() as f64;
        let spread: f64 = near().map(|other| (dt(other) - middle).powi(2)).sum();
        near().map(|other| (dt(other) - middle) * cells[other]).sum::<f64>() / spread
    };
    let mut derivatives = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        (rows.start + HALF_WINDOW..rows.end.saturating_sub(HALF_WINDOW)).for_each(|row| derivatives[row] = slope(row));
    }
    derivatives
}

/// Returns the mean of each row and the next; NaN for the last row of a contiguous range.
fn midpoints(log: &Log, cells: &[f64]) -> Vec<f64> {
    let mut means = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        (rows.start..rows.end - 1).for_each(|row| means[row] = f64::midpoint(cells[row], cells[row + 1]));
    }
    means
}
