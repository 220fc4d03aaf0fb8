//! The torque that a model's actuators make of measured states: no simulation, and so no error that adds up.

use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{dynamics::{SimdCommands, SimdActuators}, Command, JointModel, NUM_JOINTS, RobotModel, go2};

use crate::operating_conditions::OperatingConditions;
use crate::motion::{ActuatorClock, MotionError, command, joint_commands};

/// Sums of squares and counts of the torque errors of each joint [N²·m²], at the log's tap; none without a sensor, or
/// without velocities.
pub fn torque_errors(
    log: &Log,
    robot: &RobotModel,
    keep: impl Fn(usize) -> bool,
) -> Result<Option<[(f64, usize); NUM_JOINTS]>, MotionError> {
    let mut sums = [(0.0, 0); NUM_JOINTS];
    MeasuredTorque::new(log, robot)?.differences(robot, |joint, row, difference| {
        if keep(row) {
            sums[joint].0 += difference * difference;
            sums[joint].1 += 1;
        }
    });
    Ok(sums.iter().any(|(_, count)| *count > 0).then_some(sums))
}

/// Steps of an actuator in a period of it: lag and delay act within.
const SUBSTEPS: usize = 5;

/// Measured torques, and what actuators make them of.
pub struct MeasuredTorque {
    sensor: TorqueSensor,
    conditions: OperatingConditions,
    rows: Vec<TorqueSample>,
}

/// A row of a log, to the next.
struct TorqueSample {
    row: usize,
    /// The first of its part: an actuator starts there without a memory.
    after_reset: bool,
    q: [f64; NUM_JOINTS],
    dq: [f64; NUM_JOINTS],
    ddq: [f64; NUM_JOINTS],
    command: Command,
    periods: usize,
    /// NaN where it was not measured, or the velocity was not.
    torque: [f64; NUM_JOINTS],
}

impl MeasuredTorque {
    /// Those of `log`, for robots with the gains and rates of `robot`.
    pub fn new(log: &Log, robot: &RobotModel) -> Result<Self, MotionError> {
        let joints = joint_commands(log)?;
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
                let mut now = TorqueSample { row, after_reset: index == 0, q, dq: none, ddq: none, command, periods, torque };
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
        Ok(Self { sensor: log.meta().tau_sensor, conditions: OperatingConditions::of(log), rows: all })
    }

    /// Whether two robots make the same torque of the same states.
    pub fn predict_same_torque(&self, one: &RobotModel, other: &RobotModel) -> bool {
        let [one, other] = [one, other].map(|robot| upstream_of_sensor(robot, self.sensor));
        one.joints == other.joints && one.derating == other.derating
    }

    /// Hands on joint, row and the torque that the actuators of `robot` make, less the measured one [N·m].
    pub fn differences(&self, robot: &RobotModel, mut each: impl FnMut(usize, usize, f64)) {
        let robot = &upstream_of_sensor(robot, self.sensor);
        let dt = robot.control.actuator_dt() / SUBSTEPS as f64;
        let mut actuator = SimdActuators::<f64>::new(robot, dt);
        // The actuator adds its offset to what it is given; a log has it already.
        let offsets = robot.joints.map(|joint| joint.actuator.encoder_offset);
        let late = robot.joints.map(|joint| joint.actuator.sensor_delay / dt);
        // Torques of this part, a substep an entry.
        let mut made: Vec<[f64; NUM_JOINTS]> = Vec::new();
        for row in &self.rows {
            let at = |time: f64| -> [[f64; NUM_JOINTS]; 2] {
                let dq: [f64; NUM_JOINTS] = std::array::from_fn(|joint| row.dq[joint] + time * row.ddq[joint]);
                let mean = |joint: usize| 0.5 * (row.dq[joint] + dq[joint]);
                [std::array::from_fn(|joint| row.q[joint] - offsets[joint] + time * mean(joint)), dq]
            };
            if row.after_reset {
                actuator = SimdActuators::new(robot, dt);
                actuator.set(0, robot, &at(0.0)[0].map(|q| q as f32), &[0.0; NUM_JOINTS]);
                made.clear();
            }
            let strength = self.conditions.derating_factors(&robot.derating, row.row);
            let commands = SimdCommands::new(&[Command { derating_factor: strength, ..row.command }]);
            for step in 0..row.periods * SUBSTEPS {
                let [q, dq] = at(step as f64 * dt);
                if step % SUBSTEPS == 0 {
                    actuator.update_command(&commands, &q, &dq);
                }
                let forces = actuator.step(step % SUBSTEPS, &q, &dq);
                made.push(std::array::from_fn(|joint| match self.sensor {
                    TorqueSensor::JointOutput => {
                        let dry = forces.dry_friction[joint] * smooth_sign(dq[joint]);
                        let rotor = robot.joints[joint].armature * row.ddq[joint];
                        forces.tau[joint] - forces.damping[joint] * dq[joint] - dry - rotor
                    }
                    _ => actuator.estimated_torque()[joint],
                }));
            }
            for (joint, measured) in row.torque.into_iter().enumerate().filter(|(_, torque)| torque.is_finite()) {
                each(joint, row.row, delayed_mean(&made, joint, row.periods * SUBSTEPS, late[joint]) - measured);
            }
        }
    }
}

/// Mean over the last `steps` of what a sensor that is `late` steps late shows of a joint's torques.
fn delayed_mean(made: &[[f64; NUM_JOINTS]], joint: usize, steps: usize, late: f64) -> f64 {
    let at = |step: usize| {
        let place = (step as f64 - late).max(0.0);
        let (before, part) = (place as usize, place.fract());
        let after = (before + 1).min(made.len() - 1);
        made[before][joint] * (1.0 - part) + made[after][joint] * part
    };
    (made.len() - steps..made.len()).map(at).sum::<f64>() / steps as f64
}

/// The robot without what lies behind the torque's sensor, or is in the measured position already: springs at the link,
/// play and springs in the gear, whose rotor the encoder follows.
fn upstream_of_sensor(robot: &RobotModel, sensor: TorqueSensor) -> RobotModel {
    let mut robot = robot.clone();
    let ideal = go2().joints;
    for (joint, ideal) in robot.joints.iter_mut().zip(ideal) {
        joint.spring = ideal.spring;
        (joint.actuator.backlash, joint.actuator.gear_stiffness) = (ideal.actuator.backlash, ideal.actuator.gear_stiffness);
        if sensor == TorqueSensor::MotorCurrent {
            (joint.actuator.gain, joint.actuator.ripple) = (ideal.actuator.gain, ideal.actuator.ripple);
            *joint = JointModel { torque_limit: joint.torque_limit, actuator: joint.actuator, ..ideal };
        }
    }
    robot
}

/// The sign of a measured velocity, which is never quite zero.
fn smooth_sign(dq: f64) -> f64 {
    (dq / 0.02).tanh()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_sensor_shows_the_torque_of_a_while_ago() {
        let made: Vec<[f64; NUM_JOINTS]> = (0..10).map(|step| [f64::from(step); NUM_JOINTS]).collect();
        assert_eq!(delayed_mean(&made, 3, 2, 0.0), 8.5);
        assert_eq!(delayed_mean(&made, 3, 2, 2.25), 6.25);
        assert_eq!(delayed_mean(&made[..2], 3, 2, 5.0), 0.0, "nothing is before the first");
    }
}
