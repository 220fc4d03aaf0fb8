//! Gains that differ from joint to joint by a few percent, as those of equal motors do.
//!
//! They are no cause, but a nuisance: without them a search reports a part of them, or what imitates it in a standing robot:
//! a shifted centre of mass, or a sagging supply. They are fitted to all joints together, and taken into the model if that
//! is more likely than the best single cause.

use std::collections::BTreeMap;

use twinstep_effects::{Effect, EffectEntry, ModelFile, Scope};
use twinstep_model::{Joint, NUM_JOINTS, RobotModel, Rollout};

use super::cross_validation::{fit_together, parameter_penalty};
use super::hypothesis::{Hypothesis, with_effect};
use super::residual_data::ResidualData;
use super::residual_power::{STANCE, TORQUE};

/// Name of the effect.
pub const EFFECT: &str = "pd_gain";
/// Largest relative errors of the position and of the velocity gain of a joint that are a nuisance. Larger ones are a cause.
const LARGEST_ERROR: [f64; 2] = [0.1, 0.2];
/// The same of their means over the joints: what all joints have in common is a cause.
const LARGEST_MEAN_ERROR: [f64; 2] = [0.03, 0.06];
/// Relative error of the gains in the simulations of [`estimated_gain`].
const PROBE: f64 = 0.05;

/// Gains of all joints.
#[derive(Clone)]
pub struct JointGains {
    /// An entry for each joint.
    pub entries: Vec<EffectEntry>,
    /// Cross-validated log-likelihood gain minus the penalty of the parameters [nat].
    pub score: f64,
}

impl JointGains {
    /// Fits the gains of all joints on top of `model`.
    ///
    /// Returns `None` without measured torques, which distinguish gains from friction, if the estimated log-likelihood gain is
    /// less than `least` [nat], and if an error is larger than those of equal motors.
    pub fn fit(evidence: &ResidualData, model: &ModelFile, least: f64, simulator: &mut dyn Rollout) -> Option<Self> {
        let effect = Effect::named(EFFECT).expect("an effect of the catalogue");
        let hypotheses =
            Joint::ALL.map(|joint| Hypothesis { effect, scope: Scope::Joint(joint), values: vec![1.0; 2] });
        let penalty = parameter_penalty(2 * hypotheses.len());
        if !evidence.has_required_torque(effect)
            || estimated_gain(evidence, model, effect, simulator)? - penalty < least
        {
            return None;
        }
        let (score, values) = fit_together(evidence, model, &hypotheses, simulator)?;
        if !are_those_of_equal_motors(&values) {
            return None;
        }
        let entry = |(hypothesis, values): (&Hypothesis, &[f64])| {
            EffectEntry::new(effect, hypothesis.scope, values.to_vec()).ok()
        };
        let entries = hypotheses.iter().zip(values.chunks(2)).map(entry).collect::<Option<_>>()?;
        Some(Self { entries, score })
    }

    /// Returns the scales of position and velocity gain by joint.
    pub fn by_joint(&self) -> BTreeMap<String, [f64; 2]> {
        self.entries.iter().map(|entry| (entry.scope.to_string(), [entry.values[0], entry.values[1]])).collect()
    }

    /// Returns `model` with the gains.
    pub fn added_to(&self, model: &ModelFile) -> ModelFile {
        let mut model = model.clone();
        model.effects.extend(self.entries.iter().cloned());
        model
    }
}

/// Returns true if the gains of each joint, and their means over the joints, are close to 1. `values` has both gains of a joint
/// in turn.
fn are_those_of_equal_motors(values: &[f64]) -> bool {
    [0, 1].into_iter().all(|gain| {
        let errors: Vec<f64> = values.iter().skip(gain).step_by(2).map(|scale| scale - 1.0).collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        errors.iter().all(|error| error.abs() <= LARGEST_ERROR[gain]) && mean.abs() <= LARGEST_MEAN_ERROR[gain]
    })
}

/// Returns the estimated log-likelihood gain of the best gains of each joint, in its torque and position [nat].
///
/// A parabola through the sums of squares at three values of a gain has its minimum at the best value.
fn estimated_gain(
    evidence: &ResidualData,
    model: &ModelFile,
    effect: &'static Effect,
    simulator: &mut dyn Rollout,
) -> Option<f64> {
    let values = [[1.0, 1.0], [1.0 - PROBE, 1.0], [1.0 + PROBE, 1.0], [1.0, 1.0 - PROBE], [1.0, 1.0 + PROBE]];
    let robot = |values: [f64; 2]| with_effect(model, effect, Scope::All, &values).ok()?.robot_model().ok();
    let robots: Vec<RobotModel> = values.into_iter().map(robot).collect::<Option<_>>()?;
    let left = evidence.residual_powers(simulator, &robots, true);
    let sum = |candidate: usize, channel: usize| left[candidate].sums[channel].iter().sum::<f64>();
    // `first` is the candidate with the lower gain, the next one has the higher gain.
    let decrease = |channel: usize, first: usize| {
        let [middle, below, above] = [0, first, first + 1].map(|candidate| sum(candidate, channel));
        let (slope, curvature) = (0.5 * (above - below), above + below - 2.0 * middle);
        if curvature > 0.0 { 0.5 * slope * slope / curvature } else { 0.0 }
    };
    let of_channel = |channel: usize| {
        let (rows, before) = (left[0].counts[channel].iter().sum::<f64>(), sum(0, channel));
        let after = (before - decrease(channel, 1) - decrease(channel, 3)).max(0.01 * before);
        0.5 * rows / evidence.correlation_rows(channel) * ((before + 1e-9) / (after + 1e-9)).ln()
    };
    let of_joint = |joint: usize| [joint, TORQUE + joint, STANCE + joint].map(of_channel).iter().sum::<f64>();
    Some((0..NUM_JOINTS).map(of_joint).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alternating(kp: [f64; 2], kd: [f64; 2]) -> Vec<f64> {
        (0..NUM_JOINTS).flat_map(|joint| [kp[joint % 2], kd[joint % 2]]).collect()
    }

    #[test]
    fn gains_that_one_joint_or_all_have_in_common_are_no_nuisance() {
        assert!(are_those_of_equal_motors(&alternating([0.95, 1.05], [1.08, 0.94])));
        assert!(!are_those_of_equal_motors(&alternating([0.91, 0.95], [1.0, 1.0])), "all are weaker");
        assert!(!are_those_of_equal_motors(&alternating([0.95, 1.05], [0.9, 0.95])), "all have less damping");
        let mut one = alternating([0.99, 1.01], [1.0, 1.0]);
        one[3] = 0.5;
        assert!(!are_those_of_equal_motors(&one), "one joint has half of its damping");
    }
}
