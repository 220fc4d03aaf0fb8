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
/// Largest relative error of a position gain that is a nuisance. What is larger at one joint is a cause.
const LARGEST_ERROR: f64 = 0.1;
/// Relative error of the gains at which the torques are compared.
const PROBE: f64 = 0.05;

/// Gains of all joints.
pub struct JointGains {
    /// An entry for each joint.
    pub entries: Vec<EffectEntry>,
    /// Cross-validated log-likelihood gain minus the penalty of the parameters [nat].
    pub score: f64,
}

impl JointGains {
    /// Fits the gains of all joints on top of `model`.
    ///
    /// Returns `None` without measured torques, which distinguish gains from friction, if a few simulations do not promise a
    /// log-likelihood gain of `least` [nat], and if an error is larger than that of equal motors.
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
        let entry = |(hypothesis, values): (&Hypothesis, &[f64])| {
            EffectEntry::new(effect, hypothesis.scope, values.to_vec())
                .ok()
                .filter(|_| (values[0] - 1.0).abs() <= LARGEST_ERROR)
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

/// Returns the log-likelihood that the best gains of each joint gain in its torque and position [nat], from parabolas through
/// the sums of squares at three values of either gain.
fn estimated_gain(
    evidence: &ResidualData,
    model: &ModelFile,
    effect: &'static Effect,
    simulator: &mut dyn Rollout,
) -> Option<f64> {
    let values = [[1.0, 1.0], [1.0 - PROBE, 1.0], [1.0 + PROBE, 1.0], [1.0, 1.0 - PROBE], [1.0, 1.0 + PROBE]];
    let robot = |values: [f64; 2]| with_effect(model, effect, &values).ok()?.robot_model().ok();
    let robots: Vec<RobotModel> = values.into_iter().map(robot).collect::<Option<_>>()?;
    let left = evidence.residual_powers(simulator, &robots, true);
    let decrease = |channel: usize, below: usize| {
        let [middle, below, above] = [0, below, below + 1].map(|index| left[index].sums[channel].iter().sum::<f64>());
        let (slope, curvature) = (0.5 * (above - below), above + below - 2.0 * middle);
        if curvature > 0.0 { 0.5 * slope * slope / curvature } else { 0.0 }
    };
    let of_channel =
        |channel: usize| 0.5 * (decrease(channel, 1) + decrease(channel, 3)) / evidence.correlation_rows(channel);
    let of_joint = |joint: usize| [joint, TORQUE + joint, STANCE + joint].map(of_channel).iter().sum::<f64>();
    Some((0..NUM_JOINTS).map(of_joint).sum())
}
