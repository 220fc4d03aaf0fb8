//! The torque that a model's drives make of measured states: no simulation, and so no error that adds up.

use twinstep_logs::{Log, TauSensor};
use twinstep_model::lanes::{Commands, Drive};
use twinstep_model::{JointSpring, NUM_JOINTS, RobotModel};

use crate::conditions::Conditions;
use crate::motion::{DriveClock, MotionError, command, joint_commands};

/// Sums of squares and counts of the torque errors of each joint [N²·m²], at the log's tap; none without a sensor, or
/// without velocities.
pub fn torque_errors(
    log: &Log,
    robot: &RobotModel,
    keep: impl Fn(usize) -> bool,
) -> Result<Option<[(f64, usize); NUM_JOINTS]>, MotionError> {
    let joints = joint_commands(log)?;
    let clock = DriveClock::of(log, robot)?;
    let sensor = log.meta().tau_sensor;
    if sensor == TauSensor::None {
        return Ok(None);
    }
    let mut sums = [(0.0, 0); NUM_JOINTS];
    let conditions = Conditions::of(log);
    let robot = &before_the_tap(robot);
    let dt = robot.control.drive_dt();
    for (_, rows) in log.segments() {
        let t = &log.t()[rows.clone()];
        let mut drive = Drive::<f64>::new(robot, dt);
        let state = |row: usize| {
            let (mut q, mut dq) = (robot.control.default_pose, [0.0; NUM_JOINTS]);
            for joint in &joints {
                let (index, name) = (joint.joint.index(), joint.joint.name());
                // The drive adds its offset to what it is given; a log has it already.
                q[index] = log.q(name).map_or(q[index], |q| q[row]) - robot.joints[index].drive.encoder_offset;
                dq[index] = log.dq(name).map(|dq| dq[row]).filter(|dq| dq.is_finite()).unwrap_or(0.0);
            }
            (q, dq)
        };
        let (q, _) = state(rows.start);
        drive.set(0, robot, &q.map(|q| q as f32), &[0.0; NUM_JOINTS]);
        for (index, row) in rows.clone().enumerate().take(rows.len() - 1) {
            let mut command = command(robot, &joints, row);
            command.strength = conditions.strength(&robot.derating, row);
            let commands = Commands::new(&[command]);
            let ((q, dq), (_, next)) = (state(row), state(row + 1));
            let periods = clock.periods_between(t, index).max(1);
            let mut mean = [0.0; NUM_JOINTS];
            for _ in 0..periods {
                drive.tick(&commands, &q, &dq);
                let forces = drive.push(0, &q, &dq);
                for joint in 0..NUM_JOINTS {
                    let ddq = (next[joint] - dq[joint]) / (t[index + 1] - t[index]);
                    mean[joint] += match sensor {
                        TauSensor::Output => {
                            let friction =
                                forces.viscous[joint] * dq[joint] + forces.dry[joint] * smooth_sign(dq[joint]);
                            forces.tau[joint] - friction - robot.joints[joint].armature * ddq
                        }
                        _ => drive.current()[joint],
                    } / periods as f64;
                }
            }
            for joint in &joints {
                let (joint, name) = (joint.joint.index(), joint.joint.name());
                let measured = log.tau_measured(name).map_or(f64::NAN, |tau| tau[row]);
                let known = log.dq(name).is_some_and(|dq| dq[row].is_finite() && dq[row + 1].is_finite());
                if measured.is_finite() && known && keep(row) {
                    sums[joint].0 += (mean[joint] - measured).powi(2);
                    sums[joint].1 += 1;
                }
            }
        }
    }
    Ok(sums.iter().any(|(_, count)| *count > 0).then_some(sums))
}

/// The robot without what lies behind the torque's sensor, or is in the measured position already: springs at the link,
/// play and springs in the gear, whose rotor the encoder follows.
fn before_the_tap(robot: &RobotModel) -> RobotModel {
    let mut robot = robot.clone();
    for joint in &mut robot.joints {
        joint.spring = JointSpring { stiffness: 0.0, torque_at_zero: 0.0 };
        (joint.drive.gap, joint.drive.stiffness) = (0.0, f64::INFINITY);
    }
    robot
}

/// The sign of a measured velocity, which is never quite zero.
fn smooth_sign(dq: f64) -> f64 {
    (dq / 0.02).tanh()
}
