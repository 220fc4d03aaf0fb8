//! An ensemble of trained networks and its metadata.

use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, Joint, JointKind};

use crate::EnsembleError;
use crate::data::Sequence;
use crate::network::Network;
use crate::normaliser::Normalisers;
use crate::sequences::SequenceDataset;
use crate::weights::{Shape, Weights};

/// Number of sequences per batch in a prediction.
const PREDICTION_BATCH: usize = 256;

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
    /// Normalisers of inputs and output.
    pub scales: Normalisers,
    /// Location of the torque sensor in the training data.
    pub tau_sensor: TorqueSensor,
    /// kp [N·m/rad] and kd [N·m·s/rad] of each joint in the training data.
    pub gains: Vec<[f64; 2]>,
    /// Calibrated factor of the predicted variances.
    pub variance_scale: f64,
    /// Hash of the training data.
    pub data_hash: String,
    /// Seed of initial weights and order of the training data.
    pub seed: u64,
}

/// Predictive distribution of a torque.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    /// Mean [N·m].
    pub mean: f64,
    /// Variance [N²·m²].
    pub variance: f64,
}

/// Networks trained on the same data, with different initial weights and orders of the data.
#[derive(Clone, Debug, PartialEq)]
pub struct Ensemble {
    /// Properties of the training data and the networks.
    pub description: EnsembleMetadata,
    pub(crate) members: Vec<Weights>,
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

impl Ensemble {
    /// Checks that the time step of the ensemble is `dt` [s]. `what` describes the caller in the error.
    pub fn check_step(&self, what: &str, dt: f64) -> Result<(), EnsembleError> {
        let expected = self.description.dt;
        if (dt / expected - 1.0).abs() <= 1e-6 {
            return Ok(());
        }
        Err(EnsembleError::TimeStepMismatch { what: what.to_owned(), given: dt, expected })
    }

    /// Predicts the torque of each row with each member, `[sequence][row][member]`, from states of zero.
    ///
    /// As in training, the burn-in rows have no prediction: the first is of row [`Ensemble::WARM_UP`], unless the
    /// sequence begins after a reset.
    pub fn predict<'a>(&self, runs: impl Iterator<Item = &'a Sequence> + Clone) -> Vec<Vec<Vec<Gaussian>>> {
        let windows = SequenceDataset::whole(runs.clone(), &self.description);
        let mut found: Vec<Vec<Vec<Gaussian>>> = runs.map(|_| Vec::new()).collect();
        let (device, scale) = (Device::flex(), self.description.scales.torque);
        let variance_scale = self.description.variance_scale * scale.std * scale.std;
        let networks: Vec<_> =
            self.members.iter().map(|weights| Network::new(self.description.shape(), weights, &device)).collect();
        let order: Vec<usize> = (0..windows.len()).collect();
        for indices in order.chunks(PREDICTION_BATCH) {
            let batch = windows.batch(indices);
            let outputs: Vec<[Vec<f32>; 2]> = networks.iter().map(|network| network.outputs(&batch)).collect();
            for (column, window) in indices.iter().enumerate() {
                for (time, run) in (0..batch.steps).filter_map(|time| Some((time, windows.place(*window, time)?.0))) {
                    let index = time * batch.size + column;
                    let gaussian = |[mean, variance]: &[Vec<f32>; 2]| Gaussian {
                        mean: scale.mean + scale.std * f64::from(mean[index]),
                        variance: variance_scale * f64::from(variance[index]),
                    };
                    found[run].push(outputs.iter().map(gaussian).collect());
                }
            }
        }
        found
    }

    /// Number of burn-in rows before the first prediction of a sequence that does not begin after a reset.
    pub const WARM_UP: usize = crate::sequences::BURN_IN_ROWS;
}
