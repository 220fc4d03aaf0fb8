//! States of a batch of robots: what their sensors measure, and what only a simulator knows.

use crate::{NUM_JOINTS, PerJoint, PerLeg};

/// Readings of the sensors of a batch of robots: every array has one entry per robot.
///
/// A simulator and a real robot both provide it, so observations are computed from it alone.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// Time of the measurement since the robot's last reset [s].
    pub stamp: Vec<f64>,
    /// Joint position, read by the encoders [rad].
    pub q: Vec<PerJoint>,
    /// Joint velocity [rad/s].
    pub dq: Vec<PerJoint>,
    /// Torque estimated from the motor current, mean over the last actuator period [N·m].
    pub tau: Vec<PerJoint>,
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: Vec<[f32; 4]>,
    /// Angular velocity of the base, read by the gyroscope in the base frame [rad/s].
    pub gyro: Vec<[f32; 3]>,
    /// Specific force in the base frame, +9.81 m/s² upward at rest [m/s²]. `None`: no accelerometer.
    pub acc: Option<Vec<[f32; 3]>>,
    /// Motor temperature [°C]. `None`: not measured.
    pub temperature: Option<Vec<PerJoint>>,
    /// Supply voltage [V]. `None`: not measured.
    pub voltage: Option<Vec<f32>>,
    /// Reading of the force sensor in each foot [N]. `None`: not measured.
    pub foot_force: Option<Vec<PerLeg>>,
}

/// What only a simulator knows of a batch of robots: every array has one entry per robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundTruth {
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: Vec<[f32; 3]>,
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: Vec<[f32; 3]>,
    /// Angular velocity of the base, in the base frame, without the bias of the gyroscope [rad/s].
    pub base_angular_velocity: Vec<[f32; 3]>,
    /// Normal force on each foot, mean over the last physics step [N].
    pub foot_force: Vec<PerLeg>,
    /// True if the trunk or a thigh touches the ground.
    pub body_contact: Vec<bool>,
    /// Epistemic uncertainty of the actuators, mean over the joints [nat]; 0 if they do not estimate it.
    pub epistemic_uncertainty: Vec<f32>,
}

/// States of a batch of simulated robots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotStates {
    /// Readings of the sensors. The simulators have no optional sensor.
    pub measured: Measured,
    /// What the sensors do not measure.
    pub truth: GroundTruth,
}

impl RobotStates {
    /// Returns the states of `num_robots` robots at rest at the origin.
    pub fn new(num_robots: usize) -> Self {
        Self {
            measured: Measured {
                stamp: vec![0.0; num_robots],
                q: vec![[0.0; NUM_JOINTS]; num_robots],
                dq: vec![[0.0; NUM_JOINTS]; num_robots],
                tau: vec![[0.0; NUM_JOINTS]; num_robots],
                orientation: vec![[1.0, 0.0, 0.0, 0.0]; num_robots],
                gyro: vec![[0.0; 3]; num_robots],
                ..Measured::default()
            },
            truth: GroundTruth {
                base_position: vec![[0.0; 3]; num_robots],
                base_linear_velocity: vec![[0.0; 3]; num_robots],
                base_angular_velocity: vec![[0.0; 3]; num_robots],
                foot_force: vec![[0.0; 4]; num_robots],
                body_contact: vec![false; num_robots],
                epistemic_uncertainty: vec![0.0; num_robots],
            },
        }
    }

    /// Returns mutable views of consecutive chunks of up to `robots` robots.
    pub fn chunks_mut(&mut self, robots: usize) -> impl Iterator<Item = RobotStatesMut<'_>> {
        let Self { measured, truth } = self;
        let joints = measured.q.chunks_mut(robots).zip(measured.dq.chunks_mut(robots));
        let joints = joints.zip(measured.tau.chunks_mut(robots));
        let imu = measured.orientation.chunks_mut(robots).zip(measured.gyro.chunks_mut(robots));
        let velocities = truth.base_linear_velocity.chunks_mut(robots);
        let velocities = velocities.zip(truth.base_angular_velocity.chunks_mut(robots));
        let base = truth.base_position.chunks_mut(robots).zip(velocities);
        let contacts = truth.foot_force.chunks_mut(robots).zip(truth.body_contact.chunks_mut(robots));
        joints.zip(imu).zip(base).zip(contacts).map(|(((((q, dq), tau), imu), base), contacts)| RobotStatesMut {
            q,
            dq,
            tau,
            orientation: imu.0,
            gyro: imu.1,
            base_position: base.0,
            base_linear_velocity: base.1.0,
            base_angular_velocity: base.1.1,
            foot_force: contacts.0,
            body_contact: contacts.1,
        })
    }

    /// Returns a mutable view of all robots.
    pub fn all_mut(&mut self) -> RobotStatesMut<'_> {
        let Self { measured, truth } = self;
        RobotStatesMut {
            q: &mut measured.q,
            dq: &mut measured.dq,
            tau: &mut measured.tau,
            orientation: &mut measured.orientation,
            gyro: &mut measured.gyro,
            base_position: &mut truth.base_position,
            base_linear_velocity: &mut truth.base_linear_velocity,
            base_angular_velocity: &mut truth.base_angular_velocity,
            foot_force: &mut truth.foot_force,
            body_contact: &mut truth.body_contact,
        }
    }

    /// Copies the state of robot `from` of `other` to `robot`.
    pub fn copy_robot(&mut self, robot: usize, other: &RobotStates, from: usize) {
        let (measured, readings) = (&mut self.measured, &other.measured);
        measured.stamp[robot] = readings.stamp[from];
        measured.q[robot] = readings.q[from];
        measured.dq[robot] = readings.dq[from];
        measured.tau[robot] = readings.tau[from];
        measured.orientation[robot] = readings.orientation[from];
        measured.gyro[robot] = readings.gyro[from];
        let (truth, other) = (&mut self.truth, &other.truth);
        truth.base_position[robot] = other.base_position[from];
        truth.base_linear_velocity[robot] = other.base_linear_velocity[from];
        truth.base_angular_velocity[robot] = other.base_angular_velocity[from];
        truth.foot_force[robot] = other.foot_force[from];
        truth.body_contact[robot] = other.body_contact[from];
        truth.epistemic_uncertainty[robot] = other.epistemic_uncertainty[from];
    }

    /// Returns the name of the first quantity of `robot` that is not finite, or `None` if all are.
    pub fn first_not_finite(&self, robot: usize) -> Option<&'static str> {
        let Self { measured, truth } = self;
        let quantities: [(&'static str, &[f32]); 7] = [
            ("q", &measured.q[robot]),
            ("dq", &measured.dq[robot]),
            ("tau", &measured.tau[robot]),
            ("base_position", &truth.base_position[robot]),
            ("orientation", &measured.orientation[robot]),
            ("base_linear_velocity", &truth.base_linear_velocity[robot]),
            ("gyro", &measured.gyro[robot]),
        ];
        quantities.into_iter().find(|(_, values)| values.iter().any(|value| !value.is_finite())).map(|(name, _)| name)
    }
}

/// Mutable view of some robots of a [`RobotStates`], with the fields that a physics step writes.
#[allow(missing_docs, reason = "documented in `Measured` and `GroundTruth`")]
pub struct RobotStatesMut<'a> {
    pub q: &'a mut [PerJoint],
    pub dq: &'a mut [PerJoint],
    pub tau: &'a mut [PerJoint],
    pub orientation: &'a mut [[f32; 4]],
    pub gyro: &'a mut [[f32; 3]],
    pub base_position: &'a mut [[f32; 3]],
    pub base_linear_velocity: &'a mut [[f32; 3]],
    pub base_angular_velocity: &'a mut [[f32; 3]],
    pub foot_force: &'a mut [PerLeg],
    pub body_contact: &'a mut [bool],
}
