//! Command of one robot for one actuator period.

use crate::{NUM_JOINTS, PerJoint};

/// Command of one robot for one actuator period.
///
/// The torque of each joint is `kp (q − q_measured) + kd (dq − dq_measured) + tau_ff`, clipped to the joint's limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Command {
    /// Commanded joint position [rad].
    pub q: PerJoint,
    /// Commanded joint velocity [rad/s].
    pub dq: PerJoint,
    /// Feed-forward torque [N·m].
    pub tau_ff: PerJoint,
    /// Position gain [N·m/rad].
    pub kp: PerJoint,
    /// Velocity gain [N·m·s/rad].
    pub kd: PerJoint,
}

impl Command {
    /// Returns a command that holds `q` [rad] with gains `kp` [N·m/rad] and `kd` [N·m·s/rad] on every joint.
    pub fn hold(q: PerJoint, kp: f32, kd: f32) -> Self {
        Self { q, dq: [0.0; NUM_JOINTS], tau_ff: [0.0; NUM_JOINTS], kp: [kp; NUM_JOINTS], kd: [kd; NUM_JOINTS] }
    }
}
