//! Joints or part of the robot to which an entry of a model file applies.

use std::fmt;
use std::str::FromStr;

use twinstep_model::{Joint, JointKind, Leg};

/// Set of joints, or a part of the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Scope {
    /// All joints.
    All,
    /// The four joints of a kind.
    Kind(JointKind),
    /// The three joints of a leg.
    Leg(Leg),
    /// The six joints of the left legs.
    Left,
    /// The six joints of the right legs.
    Right,
    /// One joint, or its child link.
    Joint(Joint),
    /// The trunk.
    Base,
    /// The ground.
    Ground,
}

/// The text is not the name of a scope.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "\"{0}\" is not a scope; possible: all, hip, thigh, calf, FL, FR, RL, RR, left, right, a joint such as FL_hip, \
     base, ground"
)]
pub struct UnknownScope(pub String);

impl Scope {
    /// Returns every scope over joints, from the widest to the narrowest.
    pub fn of_joints() -> Vec<Scope> {
        let kinds = JointKind::ALL.into_iter().map(Scope::Kind);
        let legs = Leg::ALL.into_iter().map(Scope::Leg);
        let joints = Joint::ALL.into_iter().map(Scope::Joint);
        [Scope::All, Scope::Left, Scope::Right].into_iter().chain(kinds).chain(legs).chain(joints).collect()
    }

    /// Returns true if the scope contains the joint.
    pub fn contains(self, joint: Joint) -> bool {
        match self {
            Scope::All => true,
            Scope::Kind(kind) => joint.kind == kind,
            Scope::Leg(leg) => joint.leg == leg,
            Scope::Left => joint.leg.left_sign() > 0.0,
            Scope::Right => joint.leg.left_sign() < 0.0,
            Scope::Joint(one) => joint == one,
            Scope::Base | Scope::Ground => false,
        }
    }

    /// Returns true if all that the scope contains is in another one.
    pub fn is_within(self, other: Self) -> bool {
        self == other
            || self.joints() > 0
                && Joint::ALL.into_iter().filter(|joint| self.contains(*joint)).all(|joint| other.contains(joint))
    }

    /// Returns the number of joints in the scope.
    pub fn joints(self) -> usize {
        Joint::ALL.into_iter().filter(|joint| self.contains(*joint)).count()
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Scope::All => f.write_str("all"),
            Scope::Kind(kind) => f.write_str(match kind {
                JointKind::Hip => "hip",
                JointKind::Thigh => "thigh",
                JointKind::Calf => "calf",
            }),
            Scope::Leg(leg) => write!(f, "{leg:?}"),
            Scope::Left => f.write_str("left"),
            Scope::Right => f.write_str("right"),
            Scope::Joint(joint) => f.write_str(joint.name()),
            Scope::Base => f.write_str("base"),
            Scope::Ground => f.write_str("ground"),
        }
    }
}

impl FromStr for Scope {
    type Err = UnknownScope;

    fn from_str(text: &str) -> Result<Self, UnknownScope> {
        let known = Self::of_joints().into_iter().chain([Scope::Base, Scope::Ground]);
        known.into_iter().find(|scope| scope.to_string() == text).ok_or_else(|| UnknownScope(text.to_owned()))
    }
}
