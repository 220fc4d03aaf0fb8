//! Torque of a model's actuators on measured states. Nothing is simulated, so errors do not accumulate.

use twinstep_dynamics::{SimdActuators, SimdCommands};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{
    Actuator, ActuatorMode, ActuatorParams, ActuatorTap, Command, JointSpring, NUM_JOINTS, PerJoint, RobotModel,
    RobotStates, Stribeck,
};

use twinstep_logs::operating_conditions::OperatingConditions;
use twinstep_logs::replay::{ActuatorClock, ReplayError, at_log_rate, command, delayed_mean, joint_commands};

/// Returns the sum of squares [N²·m²] and the number of torque errors of each joint, at the log's torque sensor.
///
/// Returns `None` if torque or velocity was not measured. `external` is the external actuator of the robot, if it has one.
pub fn torque_errors(
    log: &Log,
    robot: &RobotModel,
    external: Option<Box<dyn Actuator>>,
    keep: impl Fn(usize) -> bool,
) -> Result<Option<[(f64, usize); NUM_JOINTS]>, ReplayError> {
    let mut sums = [(0.0, 0); NUM_JOINTS];
    let mut add = |joint: usize, row: usize, difference: f64| {
        if keep(row) {
            sums[joint].0 += difference * difference;
            sums[joint].1 += 1;
        }
    };
    let measured = MeasuredTorque::new(log, robot)?;
    match external {
        Some(mut external) => measured.differences_with(robot, Some(&mut *external), &mut add),
        None => measured.differences(robot, &mut add),
    }
    Ok(sums.iter().any(|(_, count)| *count > 0).then_some(sums))
}

/// Lowest rate at which lag and delay are evaluated within an actuator period [Hz].
const MIN_SUBSTEP_HZ: f64 = 1000.0;

/// Measured torques, with the states and commands from which actuators compute them.
#[derive(Debug)]
pub struct MeasuredTorque {
    /// Rate at which the actuators are replayed [Hz].
    actuator_hz: f64,
    /// Substeps per actuator period.
    substeps: usize,
    sensor: TorqueSensor,
    conditions: OperatingConditions,
    rows: Vec<TorqueSample>,
}

/// One row of a log, until the next.
#[derive(Clone, Debug)]
struct TorqueSample {
    row: usize,
    /// True for the first row of a contiguous range, at which the actuator state is reset.
    after_reset: bool,
    q: [f64; NUM_JOINTS],
    dq: [f64; NUM_JOINTS],
    ddq: [f64; NUM_JOINTS],
    command: Command,
    periods: usize,
    /// Measured torque [N·m]; NaN if torque or velocity was not measured.
    torque: [f64; NUM_JOINTS],
}

impl MeasuredTorque {
    /// Collects the samples of `log`, for robots with the gains and rates of `robot`.
    pub fn new(log: &Log, robot: &RobotModel) -> Result<Self, ReplayError> {
        let joints = joint_commands(log)?;
        let robot = &at_log_rate(log, robot)?;
        let clock = ActuatorClock::of(log, robot)?;
        let columns: Vec<_> = joints
            .iter()
            .map(|joint| {
                let name = joint.joint.name();
                (joint.joint.index(), log.q(name), log.dq(name), log.tau_measured(name))
            })
            .collect();
        let mut all = Vec::new();
        let parts = if log.meta().tau_sensor == TorqueSensor::None { Vec::new() } else { log.segments().collect() };
        for (_, rows) in parts {
            let t = &log.t()[rows.clone()];
            for (index, row) in rows.clone().enumerate().take(rows.len() - 1) {
                let periods = clock.periods_between(t, index).max(1);
                let (q, none) = (robot.control.default_pose, [0.0; NUM_JOINTS]);
                let command = command(robot, &joints, row);
                let torque = [f64::NAN; NUM_JOINTS];
                let mut now =
                    TorqueSample { row, after_reset: index == 0, q, dq: none, ddq: none, command, periods, torque };
                for (joint, q, dq, tau) in &columns {
                    now.q[*joint] = q.map_or(now.q[*joint], |q| q[row]);
                    let speeds = dq.map_or([f64::NAN; 2], |dq| [dq[row], dq[row + 1]]);
                    if speeds.iter().all(|speed| speed.is_finite()) {
                        now.dq[*joint] = speeds[0];
                        now.ddq[*joint] = (speeds[1] - speeds[0]) / (t[index + 1] - t[index]);
                        now.torque[*joint] = tau.map_or(f64::NAN, |tau| tau[row]);
                    }
                }
                all.push(now);
            }
        }
        let actuator_hz = robot.control.actuator_hz;
        let substeps = (MIN_SUBSTEP_HZ / actuator_hz).ceil().max(1.0) as usize;
        Ok(Self {
            actuator_hz,
            substeps,
            sensor: log.meta().tau_sensor,
            conditions: OperatingConditions::of(log),
            rows: all,
        })
    }

    /// Returns the contiguous ranges that contain a row for which `is_compared` is true.
    #[must_use]
    pub fn only_ranges_with(mut self, is_compared: impl Fn(usize) -> bool) -> Self {
        let ranges = self.rows.chunk_by(|_, next| !next.after_reset);
        let kept = ranges.filter(|range| range.iter().any(|sample| is_compared(sample.row)));
        self.rows = kept.flatten().cloned().collect();
        self
    }

    /// Returns true if two robots predict the same torque for the same states.
    pub fn predict_same_torque(&self, one: &RobotModel, other: &RobotModel) -> bool {
        let [one, other] = [one, other].map(|robot| upstream_of_sensor(robot, self.sensor));
        one.joints == other.joints && one.derating == other.derating
    }

    /// Calls `each` with joint, row and torque error: torque of the actuators of `robot` minus measured torque [N·m].
    pub fn differences(&self, robot: &RobotModel, each: impl FnMut(usize, usize, f64)) {
        self.differences_with(robot, None, each);
    }

    /// Returns the torque errors of `robot` by row of the log, up to the last sample; NaN where there are none [N·m].
    pub fn error_table(&self, robot: &RobotModel) -> Vec<[f64; NUM_JOINTS]> {
        let rows = self.rows.last().map_or(0, |sample| sample.row + 1);
        let mut table = vec![[f64::NAN; NUM_JOINTS]; rows];
        self.differences(robot, |joint, row, difference| table[row][joint] = difference);
        table
    }

    /// Like [`MeasuredTorque::differences`], with an external actuator that replaces the robot's or adds to them.
    ///
    /// One that replaces the torque at the joint output says nothing about the motor current, and is not compared with it.
    fn differences_with(
        &self,
        robot: &RobotModel,
        mut external: Option<&mut dyn Actuator>,
        mut each: impl FnMut(usize, usize, f64),
    ) {
        let mode = external.as_deref().map(Actuator::mode);
        if mode == Some(ActuatorMode::Replace(ActuatorTap::Output)) && self.sensor != TorqueSensor::JointOutput {
            return;
        }
        let mut robot = upstream_of_sensor(robot, self.sensor);
        robot.control.actuator_hz = self.actuator_hz;
        let robot = &robot;
        let dt = robot.control.actuator_dt() / self.substeps as f64;
        let mut actuator = SimdActuators::new(&robot.joints, robot.control.actuator_dt(), dt);
        // The actuator adds its encoder offset, which the measured positions already contain.
        let offsets = robot.joints.map(|joint| joint.actuator.encoder_offset);
        let delay = robot.joints.map(|joint| joint.actuator.sensor_delay / dt);
        // Torques since the last reset, one entry per substep.
        let mut torques: Vec<[f64; NUM_JOINTS]> = Vec::new();
        for row in &self.rows {
            let at = |time: f64| -> [[f64; NUM_JOINTS]; 2] {
                let dq: [f64; NUM_JOINTS] = std::array::from_fn(|joint| row.dq[joint] + time * row.ddq[joint]);
                let mean = |joint: usize| 0.5 * (row.dq[joint] + dq[joint]);
                [std::array::from_fn(|joint| row.q[joint] - offsets[joint] + time * mean(joint)), dq]
            };
            if row.after_reset {
                actuator = SimdActuators::new(&robot.joints, robot.control.actuator_dt(), dt);
                actuator.set(0, &robot.joints, &at(0.0)[0], &[0.0; NUM_JOINTS]);
                torques.clear();
                if let Some(external) = &mut external {
                    external.reset(0, 0);
                }
            }
            actuator.set_derating(0, &self.conditions.derating_factors(&robot.derating, row.row));
            let commands = SimdCommands::new(&[row.command]);
            let steps = row.periods * self.substeps;
            for step in 0..steps {
                let [q, dq] = at(step as f64 * dt);
                if step % self.substeps == 0 {
                    let replaced = external.as_deref_mut().map(|external| {
                        let readings = std::array::from_fn(|joint| (q[joint] + offsets[joint]) as f32);
                        (external.mode(), external_torque(external, row.command, readings, dq.map(|dq| dq as f32)))
                    });
                    match replaced {
                        Some((ActuatorMode::Replace(_), tau)) => actuator.set_torque(&tau),
                        added => {
                            actuator.update_command(&commands, &q, &dq);
                            if let Some((ActuatorMode::AddAt(tap), tau)) = added {
                                actuator.set_residual(tap, tau);
                            }
                        }
                    }
                }
                let middle = at((step as f64 + 0.5) * dt)[0];
                actuator.step(step % self.substeps, &middle, &dq);
                let forces = actuator.forces();
                torques.push(std::array::from_fn(|joint| match self.sensor {
                    TorqueSensor::JointOutput => {
                        let dry = forces.dry_friction[joint] * smooth_sign(dq[joint]);
                        let rotor = robot.joints[joint].armature * row.ddq[joint];
                        forces.tau[joint] - forces.damping[joint] * dq[joint] - dry - rotor
                    }
                    _ => actuator.estimated_torque()[joint],
                }));
            }
            for (joint, measured) in row.torque.into_iter().enumerate().filter(|(_, torque)| torque.is_finite()) {
                each(
                    joint,
                    row.row,
                    delayed_mean(|step| torques[step][joint], torques.len() - steps..torques.len(), delay[joint])
                        - measured,
                );
            }
        }
    }
}

/// Returns the torques that an external actuator computes for one robot [N·m].
fn external_torque(external: &mut dyn Actuator, command: Command, q: PerJoint, dq: PerJoint) -> [f64; NUM_JOINTS] {
    let mut states = RobotStates::new(1);
    (states.measured.q[0], states.measured.dq[0]) = (q, dq);
    let mut tau = [[0.0; NUM_JOINTS]];
    external.torques(&[command], &[true], &states.measured, &mut tau).expect("the commands of the log are supported");
    tau[0].map(f64::from)
}

/// Returns the robot without the effects that act after the torque sensor, or that the measured position contains.
///
/// These are springs at the link, and backlash and elasticity of the gear, because the encoder is at the rotor.
fn upstream_of_sensor(robot: &RobotModel, sensor: TorqueSensor) -> RobotModel {
    let mut robot = robot.clone();
    let ideal = ActuatorParams::IDEAL;
    for joint in &mut robot.joints {
        joint.spring = JointSpring::NONE;
        (joint.actuator.backlash, joint.actuator.gear_stiffness) = (ideal.backlash, ideal.gear_stiffness);
        // The measured positions contain it.
        joint.actuator.encoder_lead = ideal.encoder_lead;
        if sensor == TorqueSensor::MotorCurrent {
            (joint.actuator.gain, joint.actuator.ripple) = (ideal.gain, ideal.ripple);
            (joint.viscous_friction, joint.coulomb_friction, joint.load_friction) = (0.0, 0.0, 0.0);
            (joint.stribeck_friction, joint.armature) = (Stribeck::NONE, 0.0);
        }
    }
    robot
}

/// Returns a smooth approximation of the sign of a velocity [rad/s], because measured velocities are noisy around zero.
fn smooth_sign(dq: f64) -> f64 {
    (dq / 0.02).tanh()
}
