//! Trained members, and what their numbers depend on.

use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, Joint, JointKind};

use crate::EnsembleError;
use crate::data::Sequence;
use crate::network::Network;
use crate::scales::Normalisers;
use crate::weights::{Shape, Weights};
use crate::windows::SequenceDataset;

/// Runs that are predicted side by side.
const PREDICTION_BATCH: usize = 256;

/// What a network is told of the joint, beside ξ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointEncoding {
    /// Nothing: all joints are one actuator, as in U2E.
    Pooled,
    /// Whether it is a hip, a thigh or a calf.
    Kind,
    /// Which one it is.
    Identity,
}

/// What the numbers of an ensemble depend on; kept with them in the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnsembleMetadata {
    /// Number of networks.
    pub members: usize,
    /// Units of a network's encoder.
    pub hidden: usize,
    /// Time from a row to the next [s].
    pub dt: f64,
    /// The joints it learnt from.
    pub joints: Vec<String>,
    /// What a network is told of the joint.
    pub joint_input: JointEncoding,
    /// What is 0 and what is 1 to a network.
    pub scales: Normalisers,
    /// Where the torque was measured that it gives.
    pub tau_sensor: TorqueSensor,
    /// kp [N·m/rad] and kd [N·m·s/rad] of each joint, which it knows by heart.
    pub gains: Vec<[f64; 2]>,
    /// What the variances that the networks give are multiplied by, so that intervals cover what they should.
    pub variance_scale: f64,
    /// Fingerprint of the data it learnt from.
    pub data_hash: String,
    /// Seed of first weights and order of data.
    pub seed: u64,
}

/// A torque as a network sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    /// Mean [N·m].
    pub mean: f64,
    /// Variance [N²·m²].
    pub variance: f64,
}

/// Networks that learnt the same drives from the same data, each in its own way.
#[derive(Clone, Debug, PartialEq)]
pub struct Ensemble {
    /// What their numbers depend on.
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

    /// Which of the inputs behind ξ is 1 for the joint at an index of [`Description::joints`].
    pub(crate) fn one_hot(&self, joint: usize) -> Option<usize> {
        match self.joint_input {
            JointEncoding::Pooled => None,
            JointEncoding::Kind => kind(&self.joints[joint]),
            JointEncoding::Identity => Some(joint),
        }
    }

    /// The same for a joint of [`Joint::ALL`]; none where it is not an input, or not known.
    pub(crate) fn one_hot_index(&self, joint: usize) -> Option<usize> {
        let name = JOINT_NAMES[joint];
        match self.joint_input {
            JointEncoding::Pooled => None,
            JointEncoding::Kind => kind(name),
            JointEncoding::Identity => self.joints.iter().position(|known| known == name),
        }
    }

    /// kp [N·m/rad] and kd [N·m·s/rad] of all joints; fails if they are not the same.
    pub fn uniform_gains(&self) -> Result<[f64; 2], EnsembleError> {
        let first = self.gains[0];
        let other = (0..self.joints.len()).find(|joint| self.gains[*joint] != first);
        other.map_or(Ok(first), |other| {
            let joints = [0, other].map(|joint| self.joints[joint].clone());
            Err(EnsembleError::GainsDiffer { joints, gains: [first, self.gains[other]] })
        })
    }

    /// Fails if a joint is of no kind, where kinds are an input.
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
    /// Fails unless rows come every `dt` [s]; `what` is named in the error.
    pub fn check_step(&self, what: &str, dt: f64) -> Result<(), EnsembleError> {
        let wanted = self.description.dt;
        if (dt / wanted - 1.0).abs() <= 1e-6 {
            return Ok(());
        }
        Err(EnsembleError::TimeStepMismatch { what: what.to_owned(), given: dt, wanted })
    }

    /// What each member expects at each row of each run, which starts from a state of zero: `[run][row][member]`.
    ///
    /// Rows whose unseen past still matters are left out at the start of a run, as in training: where a run does not start
    /// a part, the first prediction is of row [`Ensemble::WARM_UP`].
    pub fn predict<'a>(&self, runs: impl Iterator<Item = &'a Sequence> + Clone) -> Vec<Vec<Vec<Gaussian>>> {
        let windows = SequenceDataset::whole(runs.clone(), &self.description);
        let mut found: Vec<Vec<Vec<Gaussian>>> = runs.map(|_| Vec::new()).collect();
        let (device, scale) = (Device::flex(), self.description.scales.torque);
        let variance_scale = self.description.variance_scale * scale.std * scale.std;
        let networks: Vec<_> =
            self.members.iter().map(|weights| Network::new(self.description.shape(), weights, &device)).collect();
        let order: Vec<usize> = (0..windows.len()).collect();
        for chosen in order.chunks(PREDICTION_BATCH) {
            let batch = windows.batch(chosen);
            let outputs: Vec<[Vec<f32>; 2]> = networks.iter().map(|network| network.outputs(&batch)).collect();
            for (column, window) in chosen.iter().enumerate() {
                for (time, run) in (0..batch.steps).filter_map(|time| Some((time, windows.place(*window, time)?.0))) {
                    let place = time * batch.size + column;
                    let gaussian = |[mean, variance]: &[Vec<f32>; 2]| Gaussian {
                        mean: scale.mean + scale.std * f64::from(mean[place]),
                        variance: variance_scale * f64::from(variance[place]),
                    };
                    found[run].push(outputs.iter().map(gaussian).collect());
                }
            }
        }
        found
    }

    /// Rows that a network hears before its first prediction, unless they are a part's first.
    pub const WARM_UP: usize = crate::windows::BURN_IN_ROWS;
}
