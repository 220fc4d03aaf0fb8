//! The robot's order of motors and feet: FR, FL, RR, RL; hip, thigh, calf.

use twinstep_model::{Joint, Leg};

/// Number of motor entries in a message. The Go2 uses the first twelve.
pub const NUM_MOTORS: usize = 20;

/// Legs and feet in the robot's order.
const ROBOT_LEGS: [Leg; 4] = [Leg::FR, Leg::FL, Leg::RR, Leg::RL];

/// Returns the index of a joint's motor in a message.
pub fn motor_index(joint: Joint) -> usize {
    foot_index(joint.leg) * 3 + joint.kind as usize
}

/// Returns the index of a leg's foot in a message.
pub fn foot_index(leg: Leg) -> usize {
    ROBOT_LEGS.iter().position(|robot| *robot == leg).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_joint_has_its_own_motor() {
        assert_eq!(Joint::ALL.map(motor_index), [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]);
        assert_eq!(Leg::ALL.map(foot_index), [1, 0, 3, 2]);
    }
}
