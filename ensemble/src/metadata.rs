//! Metadata of an ensemble.

use serde::{Deserialize, Serialize};
use twinstep_effects::NetworkMode;
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, Joint, JointKind};

use crate::EnsembleError;
use crate::network_input::{NetworkInput, NetworkTarget};
use crate::normaliser::Normalisers;
use crate::weights::Shape;

/// Encoding of the joint in the input of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointEncoding {
    /// The joint is not an input: all joints have the same actuator, as in U2E.
    Pooled,
    /// One-hot encoding of the joint type: hip, thigh or calf.
    Kind,
    /// One-hot encoding of the joint.
    Identity,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Properties of the training data and the networks, stored in the file of an ensemble.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnsembleMetadata {
    /// Number of networks.
    pub members: usize,
    /// Number of LSTM units.
    pub hidden: usize,
    /// Time step [s].
    pub dt: f64,
    /// Joints of the training data.
    pub joints: Vec<String>,
    /// Encoding of the joint in the input.
    pub joint_input: JointEncoding,
    /// The two numbers of each row in the input.
    #[serde(default, skip_serializing_if = "is_default")]
    pub input: NetworkInput,
    /// The torque that is predicted.
    #[serde(default, skip_serializing_if = "is_default")]
    pub target: NetworkTarget,
    /// Normalisers of inputs and output.
    pub scales: Normalisers,
    /// Location of the torque sensor in the training data.
    pub tau_sensor: TorqueSensor,
    /// kp [N·m/rad] and kd [N·m·s/rad] of each joint in the training data. Empty if the input is
    /// [`NetworkInput::Torque`], which serves all gains.
    pub gains: Vec<[f64; 2]>,
    /// Calibrated factor of the predicted variances.
    pub variance_scale: f64,
    /// Hash of the training data.
    pub data_hash: String,
    /// Seed of initial weights and order of the training data.
    pub seed: u64,
}

impl EnsembleMetadata {
    pub(crate) fn shape(&self) -> Shape {
        let more = match self.joint_input {
            JointEncoding::Pooled => 0,
            JointEncoding::Kind => JointKind::ALL.len(),
            JointEncoding::Identity => self.joints.len(),
        };
        Shape { inputs: 2 + more, hidden: self.hidden }
    }

    /// Returns the index of the one-hot input for a joint, given as an index into [`EnsembleMetadata::joints`].
    pub(crate) fn one_hot(&self, joint: usize) -> Option<usize> {
        match self.joint_input {
            JointEncoding::Pooled => None,
            JointEncoding::Kind => kind(&self.joints[joint]),
            JointEncoding::Identity => Some(joint),
        }
    }

    /// Returns the index of the one-hot input for a joint of [`Joint::ALL`].
    ///
    /// `None` if the joint is not an input or not in the training data.
    pub(crate) fn one_hot_index(&self, joint: usize) -> Option<usize> {
        let name = JOINT_NAMES[joint];
        match self.joint_input {
            JointEncoding::Pooled => None,
            JointEncoding::Kind => kind(name),
            JointEncoding::Identity => self.joints.iter().position(|known| known == name),
        }
    }

    /// Returns kp [N·m/rad] and kd [N·m·s/rad] of all joints. Fails if they differ.
    pub fn uniform_gains(&self) -> Result<[f64; 2], EnsembleError> {
        let first = self.gains[0];
        let other = (0..self.joints.len()).find(|joint| self.gains[*joint] != first);
        other.map_or(Ok(first), |other| {
            let joints = [0, other].map(|joint| self.joints[joint].clone());
            Err(EnsembleError::GainsDiffer { joints, gains: [first, self.gains[other]] })
        })
    }

    /// Checks that networks that predict what a model lacks are added to one, and others are not.
    pub(crate) fn check_mode(&self, mode: NetworkMode) -> Result<(), EnsembleError> {
        match (mode, self.target) {
            (NetworkMode::Replace, NetworkTarget::Torque) | (NetworkMode::Residual, NetworkTarget::Residual) => Ok(()),
            (NetworkMode::Replace, NetworkTarget::Residual) => {
                Err(EnsembleError::WrongMode { target: "the torque that a model lacks", allowed: "residual" })
            }
            (NetworkMode::Residual, NetworkTarget::Torque) => {
                Err(EnsembleError::WrongMode { target: "the whole torque", allowed: "replace" })
            }
        }
    }

    /// Checks that every joint has a type if the joint type is an input.
    pub(crate) fn check(&self) -> Result<(), EnsembleError> {
        let unknown = self.joints.iter().find(|joint| self.joint_input == JointEncoding::Kind && kind(joint).is_none());
        unknown.map_or(Ok(()), |joint| Err(EnsembleError::NoKind { joint: joint.clone() }))
    }
}

fn kind(joint: &str) -> Option<usize> {
    let joint: Joint = joint.parse().ok()?;
    JointKind::ALL.iter().position(|kind| *kind == joint.kind)
}
