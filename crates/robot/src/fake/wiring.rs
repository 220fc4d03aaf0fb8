//! Where mistakes act: on commands on their way to the motors, and on readings on their way to the message.

use glam::{Quat, Vec3};
use twinstep_model::{Command, Joint, Leg, PerJoint, frames};

use super::mistake::{Axis, Mistake};

/// Gains of an earlier configuration, in a motor that does not take new ones.
const STALE_GAINS: [f32; 2] = [60.0, 5.0];
/// Gains of a motor that holds its position.
const FROZEN_GAINS: [f32; 2] = [100.0, 4.0];

/// Readings of encoders and inertial measurement unit; joints in the order of [`Joint::ALL`].
#[derive(Clone, Debug)]
pub(super) struct Readings {
    pub q: PerJoint,
    pub dq: PerJoint,
    pub tau: PerJoint,
    /// World-from-base: w, x, y, z.
    pub quaternion: [f32; 4],
    pub gyro: Vec3,
    pub acc: Vec3,
}

/// A mistake, with the position of its joint when it was made [rad].
#[derive(Clone, Copy, Debug)]
pub(super) struct Fitted {
    pub mistake: Mistake,
    pub q: f32,
}

impl Fitted {
    /// Fits a mistake into a robot with joints at `q` [rad].
    pub fn new(mistake: Mistake, q: &PerJoint) -> Self {
        let q = match mistake {
            Mistake::EncoderDead(joint) | Mistake::MotorFrozen(joint) => q[joint.index()],
            _ => 0.0,
        };
        Self { mistake, q }
    }

    /// Changes a command to what the motors execute.
    pub fn change_command(&self, command: &mut Command) {
        match self.mistake {
            Mistake::LegsSwapped(first, second) | Mistake::CommandsSwapped(first, second) => {
                for field in [&mut command.q, &mut command.dq, &mut command.tau_ff, &mut command.kp, &mut command.kd] {
                    swap_legs(field, first, second);
                }
            }
            Mistake::JointMirrored(joint) => {
                for field in [&mut command.q, &mut command.dq, &mut command.tau_ff] {
                    field[joint.index()] *= -1.0;
                }
            }
            Mistake::JointOffset(joint, angle) => command.q[joint.index()] -= angle,
            Mistake::EncoderDead(joint) => {
                // The motor's position loop uses the reading that does not change.
                let index = joint.index();
                command.tau_ff[index] += command.kp[index] * (command.q[index] - self.q);
                command.tau_ff[index] += command.kd[index] * command.dq[index];
                (command.kp[index], command.kd[index]) = (0.0, 0.0);
            }
            Mistake::MotorFrozen(joint) => {
                let index = joint.index();
                (command.q[index], command.dq[index], command.tau_ff[index]) = (self.q, 0.0, 0.0);
                [command.kp[index], command.kd[index]] = FROZEN_GAINS;
            }
            Mistake::MotorDead(joint) => scale(command, joint, 0.0),
            Mistake::MotorWeak(joint, factor) => scale(command, joint, factor),
            Mistake::GainsStale(joint) if command.kp[joint.index()] > 0.0 => {
                [command.kp[joint.index()], command.kd[joint.index()]] = STALE_GAINS;
            }
            _ => {}
        }
    }

    /// Changes readings to those that are in the message.
    pub fn change_readings(&self, readings: &mut Readings) {
        let Readings { q, dq, tau, .. } = readings;
        match self.mistake {
            Mistake::LegsSwapped(first, second) => {
                for field in [q, dq, tau] {
                    swap_legs(field, first, second);
                }
            }
            Mistake::JointMirrored(joint) => {
                for field in [q, dq, tau] {
                    field[joint.index()] *= -1.0;
                }
            }
            Mistake::EncoderSign(joint) => {
                q[joint.index()] *= -1.0;
                dq[joint.index()] *= -1.0;
            }
            Mistake::EncoderScale(joint, factor) => {
                q[joint.index()] *= factor;
                dq[joint.index()] *= factor;
            }
            Mistake::EncoderDegrees => {
                *q = q.map(f32::to_degrees);
                *dq = dq.map(f32::to_degrees);
            }
            Mistake::JointOffset(joint, angle) | Mistake::EncoderOffset(joint, angle) => q[joint.index()] += angle,
            Mistake::EncoderDead(joint) => {
                q[joint.index()] = self.q;
                dq[joint.index()] = 0.0;
            }
            Mistake::VelocitySign(joint) => dq[joint.index()] *= -1.0,
            Mistake::VelocityScale(joint, factor) => dq[joint.index()] *= factor,
            Mistake::TorqueSign(joint) => tau[joint.index()] *= -1.0,
            _ => self.change_imu(readings),
        }
    }

    fn change_imu(&self, readings: &mut Readings) {
        let Readings { quaternion, gyro, acc, .. } = readings;
        match self.mistake {
            Mistake::QuaternionXyzw => quaternion.rotate_left(1),
            Mistake::QuaternionInverted => {
                *quaternion = frames::to_wxyz(frames::world_from_base(*quaternion).conjugate());
            }
            Mistake::GyroSwapped => *gyro = Vec3::new(gyro.y, gyro.x, gyro.z),
            Mistake::GyroDegrees => *gyro = gyro.map(f32::to_degrees),
            Mistake::GyroSign(Axis::X) => gyro.x *= -1.0,
            Mistake::GyroSign(Axis::Y) => gyro.y *= -1.0,
            Mistake::AccelerometerG => *acc /= 9.81,
            Mistake::AccelerometerSign => *acc *= -1.0,
            Mistake::ImuTurned(degrees) => {
                readings.turn_imu(Quat::from_rotation_z(f32::from(degrees).to_radians()));
            }
            Mistake::ImuUpsideDown => readings.turn_imu(Quat::from_rotation_x(std::f32::consts::PI)),
            _ => {}
        }
    }
}

impl Readings {
    /// Turns the inertial measurement unit to the orientation base-from-sensor.
    fn turn_imu(&mut self, base_from_sensor: Quat) {
        let world_from_sensor = frames::world_from_base(self.quaternion) * base_from_sensor;
        self.quaternion = frames::to_wxyz(world_from_sensor);
        self.gyro = base_from_sensor.inverse() * self.gyro;
        self.acc = base_from_sensor.inverse() * self.acc;
    }
}

fn swap_legs(values: &mut PerJoint, first: Leg, second: Leg) {
    for kind in 0..3 {
        values.swap(3 * first as usize + kind, 3 * second as usize + kind);
    }
}

fn scale(command: &mut Command, joint: Joint, factor: f32) {
    for field in [&mut command.kp, &mut command.kd, &mut command.tau_ff] {
        field[joint.index()] *= factor;
    }
}
