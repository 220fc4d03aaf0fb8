//! The twelve joints, their names and their order.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Number of joints of the robot.
pub const NUM_JOINTS: usize = 12;
/// Number of legs of the robot.
pub const NUM_LEGS: usize = 4;

/// One value for each joint, in the order of [`Joint::ALL`].
pub type PerJoint = [f32; NUM_JOINTS];
/// One value for each leg, in the order of [`Leg::ALL`].
pub type PerLeg = [f32; NUM_LEGS];

/// A leg: front or rear, left or right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Leg {
    /// Front left.
    FL,
    /// Front right.
    FR,
    /// Rear left.
    RL,
    /// Rear right.
    RR,
}

impl Leg {
    /// Every leg, in the order that arrays, files and messages use.
    pub const ALL: [Leg; NUM_LEGS] = [Leg::FL, Leg::FR, Leg::RL, Leg::RR];

    /// Returns +1 for the front legs, −1 for the rear legs.
    pub const fn front_sign(self) -> f64 {
        match self {
            Leg::FL | Leg::FR => 1.0,
            Leg::RL | Leg::RR => -1.0,
        }
    }

    /// Returns +1 for the left legs, −1 for the right legs.
    pub const fn left_sign(self) -> f64 {
        match self {
            Leg::FL | Leg::RL => 1.0,
            Leg::FR | Leg::RR => -1.0,
        }
    }

    /// Returns the leg's name in files, messages and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Leg::FL => "FL",
            Leg::FR => "FR",
            Leg::RL => "RL",
            Leg::RR => "RR",
        }
    }
}

/// Kind of a joint: hip, thigh or calf, from the trunk outwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JointKind {
    /// Hip abduction, about x.
    Hip,
    /// Hip flexion, about y.
    Thigh,
    /// Knee flexion, about y.
    Calf,
}

impl JointKind {
    /// Every kind, from the trunk outwards.
    pub const ALL: [JointKind; 3] = [JointKind::Hip, JointKind::Thigh, JointKind::Calf];

    /// Returns the kind's name in files, messages and reports.
    pub const fn name(self) -> &'static str {
        match self {
            JointKind::Hip => "hip",
            JointKind::Thigh => "thigh",
            JointKind::Calf => "calf",
        }
    }
}

/// One of the twelve joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Joint {
    /// The leg of the joint.
    pub leg: Leg,
    /// Kind of the joint.
    pub kind: JointKind,
}

/// Names of the joints, in the order of [`Joint::ALL`].
pub const JOINT_NAMES: [&str; NUM_JOINTS] = [
    "FL_hip", "FL_thigh", "FL_calf", "FR_hip", "FR_thigh", "FR_calf", "RL_hip", "RL_thigh", "RL_calf", "RR_hip",
    "RR_thigh", "RR_calf",
];

impl Joint {
    /// Every joint in the order of all arrays, files and messages: FL, FR, RL, RR; hip, thigh, calf.
    pub const ALL: [Joint; NUM_JOINTS] = {
        let mut all = [Joint { leg: Leg::FL, kind: JointKind::Hip }; NUM_JOINTS];
        let mut index = 0;
        while index < NUM_JOINTS {
            all[index] = Joint { leg: Leg::ALL[index / 3], kind: JointKind::ALL[index % 3] };
            index += 1;
        }
        all
    };

    /// Returns the index of the joint in [`Joint::ALL`].
    pub const fn index(self) -> usize {
        self.leg as usize * 3 + self.kind as usize
    }

    /// Returns the joint's name, such as `FL_hip`.
    pub const fn name(self) -> &'static str {
        JOINT_NAMES[self.index()]
    }

    /// Returns one value for each joint, given the value of each kind.
    pub fn map_kinds<T: Copy>(hip: T, thigh: T, calf: T) -> [T; NUM_JOINTS] {
        Joint::ALL.map(|joint| match joint.kind {
            JointKind::Hip => hip,
            JointKind::Thigh => thigh,
            JointKind::Calf => calf,
        })
    }
}

impl fmt::Display for Joint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// No joint has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no joint is named `{0}`; possible: {names}", names = JOINT_NAMES.join(", "))]
pub struct UnknownJoint(pub String);

impl FromStr for Joint {
    type Err = UnknownJoint;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Joint::ALL.into_iter().find(|joint| joint.name() == name).ok_or_else(|| UnknownJoint(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_legs_then_kinds() {
        for (index, joint) in Joint::ALL.into_iter().enumerate() {
            assert_eq!(joint.index(), index);
            assert_eq!(joint.name(), format!("{}_{}", joint.leg.name(), joint.kind.name()));
            assert_eq!(joint.name().parse::<Joint>().as_ref(), Ok(&joint));
        }
    }

    #[test]
    fn error_for_an_unknown_joint_lists_the_names() {
        let error = "FL_hips".parse::<Joint>().expect_err("no such joint").to_string();
        assert!(error.contains("FL_hips") && error.contains("RR_calf"), "{error}");
    }
}
