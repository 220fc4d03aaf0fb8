//! One state of the robot, with the command that was in force.

use glam::Vec3;
use twinstep_model::{Joint, PerJoint, frames};
use twinstep_unitree::{LowState, motor_index};

/// Measurements of one state; joints in the order of [`Joint::ALL`].
#[derive(Clone, Debug)]
pub(super) struct Sample {
    /// Time on the loop's clock [s].
    pub time: f64,
    pub q: PerJoint,
    pub dq: PerJoint,
    pub tau: PerJoint,
    /// As it is in the message; w, x, y, z if it is right.
    pub quaternion: [f32; 4],
    pub gyro: Vec3,
    pub acc: Vec3,
    /// Positions of the last command [rad].
    pub q_command: PerJoint,
}

impl Sample {
    pub fn new(state: &LowState, time: f64, q_command: PerJoint) -> Self {
        let motors = Joint::ALL.map(|joint| state.motor_state[motor_index(joint)]);
        Self {
            time,
            q: motors.map(|motor| motor.q),
            dq: motors.map(|motor| motor.dq),
            tau: motors.map(|motor| motor.tau_est),
            quaternion: state.imu_state.quaternion,
            gyro: Vec3::from(state.imu_state.gyroscope),
            acc: Vec3::from(state.imu_state.accelerometer),
            q_command,
        }
    }

    /// Returns the unit vector up in the base frame, from the quaternion.
    pub fn up(&self) -> Vec3 {
        -frames::projected_gravity(self.quaternion)
    }
}

/// Longest time between two states that follow each other, and between two steps [s].
pub(super) const MAX_GAP_S: f64 = 0.005;
/// States after a longer time that are not used: those that waited meanwhile arrive faster than they were sent.
const SETTLING: usize = 15;

/// Smallest share of the states of a motion that must be usable.
pub(super) const MIN_USED: f64 = 0.6;
/// States of the robot [Hz].
const STATES_HZ: f64 = 500.0;

/// Returns true if this computer stood still during so much of a motion of `seconds` that the motion has to be repeated.
pub(super) fn is_disturbed(samples: &[Sample], seconds: f64) -> bool {
    let used = without_gaps(samples).iter().map(|samples| samples.len()).sum::<usize>();
    (used as f64) < MIN_USED * seconds * STATES_HZ
}

/// Returns the parts of samples in which states follow each other without a gap.
///
/// Where this computer stood still, the command in force and the time between two states are not known.
pub(super) fn without_gaps(samples: &[Sample]) -> Vec<&[Sample]> {
    let mut parts = samples.chunk_by(|before, after| after.time - before.time <= MAX_GAP_S);
    let first = parts.next().into_iter();
    first.chain(parts.map(|part| &part[SETTLING.min(part.len())..])).collect()
}

/// Returns the mean of a vector over samples; zero without samples.
pub(super) fn mean(samples: &[Sample], value: impl Fn(&Sample) -> Vec3) -> Vec3 {
    samples.iter().map(value).sum::<Vec3>() / samples.len().max(1) as f32
}

/// Returns the mean of each joint's value over samples.
pub(super) fn joint_mean(samples: &[Sample], value: impl Fn(&Sample) -> PerJoint) -> PerJoint {
    let mut sum = [0.0; 12];
    for sample in samples {
        for (sum, value) in sum.iter_mut().zip(value(sample)) {
            *sum += value;
        }
    }
    sum.map(|sum| sum / samples.len().max(1) as f32)
}
