//! Text of the model file of a robot of any tree.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use toml::Table;
use twinstep_model::NUM_JOINTS;

use super::tree_shapes::ShapeText;
use crate::nominal::JointsTable;

/// A gain for all joints, or one for each.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, or a table with a number for each joint, such as { elbow = 20.0 }")]
pub enum NominalGain {
    /// One gain for all joints.
    All(f64),
    /// Gains by joint.
    PerJoint(BTreeMap<String, f64>),
}

impl NominalGain {
    /// Returns the gain of a joint; `None` if it is unknown.
    pub fn of(&self, joint: &str) -> Option<f64> {
        match self {
            Self::All(gain) => Some(*gain),
            Self::PerJoint(gains) => gains.get(joint).copied(),
        }
    }
}

/// Table `[groups]`: links and joints that tasks need, by name. What is left out follows from the default pose.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TreeGroups {
    /// Links on which the robot stands. Default: those that touch the ground in the default pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub foot: Option<Vec<String>>,
    /// Joints that a walk does not need. Default: those that carry no foot, and those whose axis does not point sideways.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hip: Option<Vec<String>>,
}

/// The whole file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TreeText {
    pub robot: String,
    #[serde(default, skip_serializing_if = "is_default")]
    pub control: Control,
    #[serde(default, skip_serializing_if = "is_default")]
    pub joints: Joints,
    #[serde(default, skip_serializing_if = "is_default")]
    pub groups: TreeGroups,
    #[serde(default, skip_serializing_if = "is_default")]
    pub shapes: BTreeMap<String, Vec<ShapeText>>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub effect: Vec<Table>,
}

/// Returns true if a table says nothing.
pub fn is_default<T: Default + PartialEq>(table: &T) -> bool {
    *table == T::default()
}

/// Table `[control]`.
#[derive(Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Control {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kp: Option<NominalGain>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kd: Option<NominalGain>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actuator_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub action_scale: Option<f64>,
    #[serde(default, skip_serializing_if = "is_default")]
    pub default_pose: Pose,
}

/// Default pose: by joint, or as in the model file of a quadruped, in the order FL, FR, RL, RR; hip, thigh, calf.
#[derive(Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "a table with a position for each joint, such as { elbow = 0.5 }, or the twelve positions of a quadruped"
)]
pub enum Pose {
    PerJoint(BTreeMap<String, f64>),
    Quadruped([f64; NUM_JOINTS]),
}

impl Default for Pose {
    fn default() -> Self {
        Self::PerJoint(BTreeMap::new())
    }
}

/// Table `[joints]`.
#[derive(Default, PartialEq, Serialize, Deserialize)]
pub struct Joints {
    #[serde(default)]
    pub rename: BTreeMap<String, String>,
    /// Names of the joints of a quadruped, and its feet, which a tree does not need.
    #[serde(flatten)]
    pub of_quadruped: JointsTable,
}
