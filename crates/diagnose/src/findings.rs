//! What a diagnosis says: `findings.json`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// What is wrong with a model, by what was held out of every choice and fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Diagnosis {
    /// Errors of the model that was given.
    pub baseline: RmsErrors,
    /// Errors with the findings added to it.
    pub extended: RmsErrors,
    /// Errors that the sensors alone would leave.
    pub noise_floor: RmsErrors,
    /// Named causes, the largest gain first; empty when nothing is wrong, or when no name is earned.
    pub findings: Vec<Cause>,
    /// What this log cannot tell apart.
    pub confusable: Vec<CorrelatedPair>,
    /// What is left.
    pub unexplained: Unexplained,
    /// The motion that would tell apart what this log cannot; none when there is nothing to tell, or none of ours does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_experiment: Option<NextExperiment>,
    /// The corrected model, beside this file.
    pub extended_model: String,
}

/// Root mean square errors; null where the log cannot tell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RmsErrors {
    /// Torque at the log's tap, driven by the measured states and commands [N·m].
    pub torque_rmse_nm: Option<f64>,
    /// Joint positions in closed loop [rad].
    pub q_rmse_rad: Option<f64>,
}

/// A named cause: what is to be added to the model, multiplied into it or set in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// The effect of the catalogue.
    pub effect: String,
    /// What it is about.
    pub scope: String,
    /// Its parameters by name; vectors are lists.
    pub parameters: BTreeMap<String, Estimate>,
    /// 1 − RMSE after / RMSE before, on the held-out residuals where the effect acts, on top of the causes before it.
    pub held_out_gain: f64,
    /// Evidence for it on held-out blocks [nats].
    pub score_nats: f64,
    /// It had to be more: a constant.
    pub threshold_nats: f64,
    /// Effects with scope, as in `armature@calf`, that explain as much: this log cannot tell.
    pub ambiguous_with: Vec<String>,
    /// The best of the others.
    pub rivals: Vec<AlternativeCause>,
    /// What a robot engineer would say.
    pub evidence: String,
}

/// A value with its 95 % interval.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The value.
    pub value: ParameterValue,
    /// Lower end.
    pub low: ParameterValue,
    /// Upper end.
    pub high: ParameterValue,
}

/// A number or a vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ParameterValue {
    /// A number.
    Number(f64),
    /// A vector.
    Vector(Vec<f64>),
}

/// Another cause that was tried.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlternativeCause {
    /// The effect.
    pub effect: String,
    /// What it is about.
    pub scope: String,
    /// Its gain in place of the cause.
    pub held_out_gain: f64,
}

/// Effects that this log cannot tell apart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CorrelatedPair {
    /// Their names.
    pub effects: [String; 2],
    /// Correlation of their sizes.
    pub correlation: f64,
    /// What to run next.
    pub experiment: String,
}

/// What to play next.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NextExperiment {
    /// Its motion, a folder beside this file that `twinstep play` reads.
    pub motion: String,
    /// What it parts.
    pub parts: Vec<DiscriminatedPair>,
    /// In a sentence.
    pub text: String,
}

/// Two causes that a motion parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DiscriminatedPair {
    /// As in `["backlash@RR_calf", "joint_elasticity@RR_calf"]`.
    pub effects: [String; 2],
    /// Evidence for the true one that is expected of the motion [nats].
    pub predicted_nats: f64,
    /// The same of the median motion that was looked at.
    pub median_nats: f64,
}

/// What is left when all that is named is explained.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Unexplained {
    /// Share of the residual power above the noise floor.
    pub fraction: f64,
    /// Channels that what is left depends on, such as `q_FR_hip`, the strongest first.
    pub depends_on: Vec<String>,
    /// In a sentence.
    pub text: String,
}
