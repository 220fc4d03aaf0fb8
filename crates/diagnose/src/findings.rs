//! Result of a diagnosis: `findings.json`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Result of a diagnosis. The errors are on held-out blocks, which take no part in any selection or fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Diagnosis {
    /// Errors of the given model.
    pub baseline: RmsErrors,
    /// Errors of the given model with the causes.
    pub extended: RmsErrors,
    /// Errors due to sensor noise alone.
    pub noise_floor: RmsErrors,
    /// Causes, in the order in which they were found; empty if no candidate reaches the threshold.
    pub findings: Vec<Cause>,
    /// Scale of the position gain and of the velocity gain by joint, if the gains differ from joint to joint by as little as
    /// those of equal motors. They are no cause; the extended model has them. Empty if they do not differ.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub joint_gains: BTreeMap<String, [f64; 2]>,
    /// Entries of the extended model that are no cause, as `effect@scope`: they belong to the best fit, and are too small or too uncertain
    /// for a name.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub also_fitted: Vec<String>,
    /// Pairs of causes with highly correlated estimates.
    pub confusable: Vec<CorrelatedPair>,
    /// Unexplained residual.
    pub unexplained: Unexplained,
    /// By how much the extended model, without networks, was predicted to reduce the error of the held-out blocks, and what was found. `None`
    /// without causes or positions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub promise: Option<Promise>,
    /// Networks that have learned what no cause explains; `None` if there is little of it, or they do not predict it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learned_residual: Option<LearnedResidual>,
    /// Experiment that discriminates between ambiguous causes; `None` if there are none, or no trajectory
    /// discriminates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_experiment: Option<NextExperiment>,
    /// Why a cause was added, changed or removed, in order: the evidence of each candidate that was fitted [nat]. Empty if the log has no
    /// motor currents.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub decisions: Vec<String>,
    /// The effects of the catalogue that are no cause, the closest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_reported: Vec<NotReported>,
    /// File name of the corrected model, in the same folder.
    pub extended_model: String,
}

/// An effect of the catalogue that is no cause.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NotReported {
    /// Name of the effect.
    pub effect: String,
    /// Its best scope; `None` if it explains nothing.
    pub scope: Option<String>,
    /// By how much it would be better than what was found, by the screening [nat].
    pub gain_nats: Option<f64>,
    /// Why it is no cause, as a sentence.
    pub reason: String,
}

/// Function of what a joint measures: a part of a law that the catalogue does not have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LawTerm {
    /// Formula of position q [rad], velocity dq [rad/s], position error e [rad], torque tau [N·m], temperature T [°C] and time t [s].
    pub formula: String,
    /// Factor of the formula, for a torque [N·m], or an angle between encoder and link [rad].
    pub coefficient: f64,
    /// Torque, root mean square over the log, with the sign of the factor [N·m].
    pub torque_nm: f64,
    /// 95 % interval [N·m].
    pub interval: [f64; 2],
}

impl Diagnosis {
    /// Returns the smallest and the largest scale of the position gain, and of the velocity gain, if the gains of the joints
    /// differ.
    pub fn joint_gain_ranges(&self) -> Option<[[f64; 2]; 2]> {
        let range = |gain: usize| {
            let scales = || self.joint_gains.values().map(|scales| scales[gain]);
            [scales().fold(f64::INFINITY, f64::min), scales().fold(0.0, f64::max)]
        };
        (!self.joint_gains.is_empty()).then(|| [0, 1].map(range))
    }
}

/// Networks that have learned the torque that no cause explains. The extended model adds it to its laws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearnedResidual {
    /// File name of the ensemble, in the same folder.
    pub ensemble: String,
    /// Place at which the torque is added: `current` or `output`.
    pub tap: String,
    /// Errors of the causes alone on held-out blocks.
    pub before: RmsErrors,
    /// Errors of the causes with the learned torque on held-out blocks, on which it was not trained.
    pub after: RmsErrors,
    /// Largest absolute torque that was asked for in the training data [N·m]. Beyond it nothing was learned.
    pub max_torque_nm: f64,
    /// Largest joint speed in the training data [rad/s].
    pub max_speed_rad_s: f64,
    /// Epistemic uncertainty on held-out rows, divided by that on rows of the training: how far the networks agree less
    /// where they were not trained. `None` if the held-out rows are too few.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uncertainty_ratio: Option<f64>,
}

/// Predicted reduction of the position error of joints in closed loop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Promise {
    /// Of all joints together.
    pub all: Reduction,
    /// Of each joint, by name.
    pub by_joint: BTreeMap<String, Reduction>,
    /// In each motion, by the name of its segments.
    pub by_motion: BTreeMap<String, Reduction>,
}

/// Reduction of an error: 1 − RMSE after / RMSE before.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reduction {
    /// Median of the prediction; negative if the error is expected to grow.
    pub predicted: f64,
    /// 90 % interval.
    pub interval: [f64; 2],
    /// What was found.
    pub found: f64,
}

impl Reduction {
    /// Returns the relative change of the error: predicted, both ends of the 90 % interval, the lower one first, and found.
    pub fn changes(&self) -> [f64; 4] {
        [self.predicted, self.interval[1], self.interval[0], self.found].map(|reduction| -reduction)
    }
}

/// Root mean square errors; null if they were not measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RmsErrors {
    /// Torque error at the log's torque sensor, computed from measured states and commands [N·m].
    pub torque_rmse_nm: Option<f64>,
    /// Position error of the joints in closed loop [rad].
    pub q_rmse_rad: Option<f64>,
}

/// Effect with scope and values that the model lacks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// Name of the effect in the catalogue.
    pub effect: String,
    /// Scope of the effect.
    pub scope: String,
    /// Estimates of the parameters, by name.
    pub parameters: BTreeMap<String, Estimate>,
    /// 1 − RMSE after / RMSE before, in the equations that it changes, on top of the other causes.
    pub held_out_gain: f64,
    /// Evidence of all causes minus that without this one [nat].
    pub score_nats: f64,
    /// Evidence that a cause must gain [nat].
    pub threshold_nats: f64,
    /// Ambiguous alternatives, which explain the log equally well, as in `armature@calf`.
    pub ambiguous_with: Vec<String>,
    /// The hypotheses that the log cannot tell apart, the cause first, with their posterior probabilities.
    #[serde(default)]
    pub posterior: Vec<WeightedHypothesis>,
    /// Values of the first parameter in the first and in the second half of the log, if they differ by more than the law
    /// allows: then the law is not the true one, or the robot changes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drifts: Option<[f64; 2]>,
    /// What to do about it, as a sentence.
    #[serde(default)]
    pub remedy: String,
    /// Best alternative hypotheses.
    pub rivals: Vec<AlternativeCause>,
    /// Explanation of the cause, as text.
    pub evidence: String,
}

/// Estimate of a parameter with its 95 % interval.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Estimated value.
    pub value: ParameterValue,
    /// Lower end of the interval.
    pub low: ParameterValue,
    /// Upper end of the interval.
    pub high: ParameterValue,
}

/// Value of a parameter: a number or a vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ParameterValue {
    /// A number.
    Number(f64),
    /// A vector.
    Vector(Vec<f64>),
}

/// Hypothesis with its posterior probability among those that the log cannot tell apart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WeightedHypothesis {
    /// Name of the effect.
    pub effect: String,
    /// Scope of the effect.
    pub scope: String,
    /// Probability, if one of them is the cause and all were equally likely before the log.
    pub probability: f64,
}

/// Alternative hypothesis in place of a cause.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlternativeCause {
    /// Name of the effect.
    pub effect: String,
    /// Scope of the effect.
    pub scope: String,
    /// 1 − RMSE after / RMSE before in place of the cause, cross-validated in the affected channels.
    pub held_out_gain: f64,
}

/// Pair of causes with highly correlated estimates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CorrelatedPair {
    /// Names of the effects.
    pub effects: [String; 2],
    /// Correlation of the estimates.
    pub correlation: f64,
    /// Experiment that discriminates between the effects.
    pub experiment: String,
}

/// Proposed experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NextExperiment {
    /// Motion file for `twinstep play`: name of a folder in the same folder.
    pub motion: String,
    /// Pairs of causes between which it discriminates.
    pub parts: Vec<DiscriminatedPair>,
    /// Description, as text.
    pub text: String,
}

/// Two causes between which an experiment discriminates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiscriminatedPair {
    /// Names with scopes, as in `["backlash@RR_calf", "joint_elasticity@RR_calf"]`.
    pub effects: [String; 2],
    /// Expected log-likelihood ratio of the true cause to the other [nat].
    pub predicted_nats: f64,
    /// Expected log-likelihood ratio for the median trajectory [nat].
    pub median_nats: f64,
}

/// Residual that the causes do not explain.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Unexplained {
    /// Residual power above noise, divided by that of the given model.
    pub fraction: f64,
    /// Channels on which the residual depends, such as `q_FR_hip`, the strongest first.
    pub depends_on: Vec<String>,
    /// The law that the catalogue does not have: the sum of these functions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub law: Vec<LawTerm>,
    /// Description, as text.
    pub text: String,
}
