//! One robot over one actuator period: what its sensors measured, what was commanded, and the torque that followed.

use crate::{Command, GroundTruth, Measured, PerJoint};

/// Reading at the beginning of an actuator period, and command and torque within it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RobotSample {
    /// Joint position, read by the encoders [rad].
    pub q: PerJoint,
    /// Joint velocity [rad/s].
    pub dq: PerJoint,
    /// Commanded joint position [rad].
    pub q_cmd: PerJoint,
    /// Torque estimated from the motor current, mean over the period [N·m].
    pub tau: PerJoint,
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Angular velocity of the base, read by the gyroscope in the base frame [rad/s].
    pub gyro: [f32; 3],
    /// Position [m] and velocity [m/s] of the base in the world frame. `None` on a real robot.
    pub base: Option<[[f32; 3]; 2]>,
}

impl RobotSample {
    /// Returns the sample of a robot at the beginning of a period, with a torque of zero.
    pub fn before(measured: &Measured, truth: Option<&GroundTruth>, robot: usize, command: &Command) -> Self {
        Self {
            q: measured.q[robot],
            dq: measured.dq[robot],
            q_cmd: command.q,
            tau: PerJoint::default(),
            orientation: measured.orientation[robot],
            gyro: measured.gyro[robot],
            base: truth.map(|truth| [truth.base_position[robot], truth.base_linear_velocity[robot]]),
        }
    }
}
