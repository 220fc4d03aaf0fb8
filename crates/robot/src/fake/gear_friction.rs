//! Friction that keeps a motor without gains where it is. A motor that damps its joint has none, like one that holds it.

use twinstep_model::{Command, PerJoint};

/// Stiffness before it slides [N·m/rad].
const STIFFNESS: f32 = 20.0;
/// Drag [N·m·s/rad].
const DRAG: f32 = 1.0;

/// Friction of gears, where no position is commanded: a joint that is held or walks has that of the model alone.
#[derive(Clone, Copy, Debug)]
pub struct GearFriction {
    /// Torque at which a joint slides [N·m].
    sliding: f32,
    /// Position to which each joint sticks [rad].
    anchor: PerJoint,
}

impl GearFriction {
    /// Returns friction under which a joint slides at a torque of `sliding` [N·m]; 0 leaves the drag alone.
    pub fn new(sliding: f32) -> Self {
        Self { sliding, anchor: PerJoint::default() }
    }

    /// Adds friction to a command, for joints at `q` [rad].
    pub fn add(&mut self, command: &mut Command, q: &PerJoint) {
        if self.sliding == 0.0 {
            command.kd = command.kd.map(|kd| if kd == 0.0 { DRAG } else { kd });
            return;
        }
        let reach = self.sliding / STIFFNESS;
        for (joint, (anchor, q)) in self.anchor.iter_mut().zip(q).enumerate() {
            if command.kp[joint] != 0.0 || command.kd[joint] > DRAG {
                *anchor = *q;
                continue;
            }
            *anchor = anchor.clamp(q - reach, q + reach);
            (command.q[joint], command.kp[joint]) = (*anchor, STIFFNESS);
            command.kd[joint] = DRAG;
        }
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::NUM_JOINTS;

    use super::*;

    #[test]
    fn joint_without_gains_sticks_until_it_slides() {
        let mut friction = GearFriction::new(0.6);
        let mut torque = |q: f32, kp: f32| {
            let mut command = Command::hold([1.0; NUM_JOINTS], kp, 0.0);
            friction.add(&mut command, &[q; NUM_JOINTS]);
            command.kp[0] * (command.q[0] - q)
        };
        assert!((torque(0.01, 0.0) + 0.2).abs() < 1e-5, "sticks");
        assert!((torque(0.5, 0.0) + 0.6).abs() < 1e-5, "slides");
        assert!((torque(0.49, 0.0) + 0.4).abs() < 1e-4, "sticks to where it came to rest");
        assert_eq!(torque(0.5, 30.0), 15.0, "a position is commanded");
        assert_eq!(torque(0.5, 0.0), 0.0, "it sticks to where it was held");
    }
}
