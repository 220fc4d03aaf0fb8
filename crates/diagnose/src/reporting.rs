//! Conversion of fits to reported findings: intervals, estimates and explanations.

use std::collections::BTreeMap;

use nalgebra::DMatrix;
use twinstep_effects::{Effect, ModelFile, Target};

use super::cross_validation::{CandidateFit, FitProblem};
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;
use crate::findings::{AlternativeCause, CorrelatedPair, Estimate, ParameterValue, RmsErrors};
use twinstep_identify::experiment::ResidualChannel;
use twinstep_identify::parameter::set_intervals;

/// Absolute correlation from which a pair of causes is reported.
const CORRELATED: f64 = 0.9;
/// Relative standard deviation of an effect's size between two simulators of the same law.
///
/// Measured in blind tests during development: errors of 1 to 2 % in speed limits, delays and gains were outside of
/// narrower intervals.
pub const SIMULATOR_MISMATCH_REL_STD: f64 = 0.015;
/// The same for the ground: its contact laws differ most. In three cases with MuJoCo the error was 0.3, 3.4 and 5.1 %.
const GROUND_MISMATCH_REL_STD: f64 = 0.04;
/// Half width of the central 95 % interval of a normal distribution [standard deviations].
pub const TWO_SIDED_95: f64 = 1.96;

/// Returns the model of a fit with intervals, and pairs of highly correlated causes.
///
/// `min_std` is a lower bound on each standard deviation [prior std]. `near` is the profile-likelihood interval of each
/// parameter [coordinates].
pub fn with_intervals(
    fit: &FitProblem,
    covariance: Option<&DMatrix<f64>>,
    min_std: f64,
    near: &[[f64; 2]],
) -> (ModelFile, Vec<CorrelatedPair>) {
    let mut model = fit.model(&fit.initial_point);
    let deviation = |index: usize| covariance.map_or(1.0, |covariance| covariance[(index, index)].sqrt().max(min_std));
    let intervals: Vec<Option<[f64; 2]>> = fit
        .unknowns
        .iter()
        .enumerate()
        .map(|(index, unknown)| {
            let size = (fit.initial_point[index] - unknown.coordinate(unknown.neutral)).abs();
            let mismatch = match unknown.effect.target {
                Target::Ground => GROUND_MISMATCH_REL_STD,
                _ => SIMULATOR_MISMATCH_REL_STD,
            };
            let half = TWO_SIDED_95 * (deviation(index) * unknown.prior[1]).max(mismatch * size);
            let [low, high] = near[index];
            let ends = [low.min(fit.initial_point[index] - half), high.max(fit.initial_point[index] + half)]
                .map(|end| unknown.value(end));
            Some([ends[0].min(ends[1]), ends[0].max(ends[1])])
        })
        .collect();
    set_intervals(&mut model, &fit.unknowns, &intervals);
    let mut confusable = Vec::new();
    for (i, one) in fit.unknowns.iter().enumerate() {
        for (j, other) in fit.unknowns.iter().enumerate().take(i) {
            let correlation = covariance.map_or(0.0, |covariance| covariance[(i, j)] / (deviation(i) * deviation(j)));
            if correlation.abs() >= CORRELATED && one.effect != other.effect {
                confusable.push(CorrelatedPair {
                    effects: [other.effect.name.to_owned(), one.effect.name.to_owned()],
                    correlation,
                    experiment: experiment_between(one.effect, other.effect),
                });
            }
        }
    }
    (model, confusable)
}

/// Returns the experiment that discriminates between two effects.
pub fn experiment_between(one: &Effect, other: &Effect) -> String {
    let known = |from: &Effect, to: &Effect| {
        let mut confounders = from.confounders.iter();
        confounders.find(|confounder| confounder.effect == to.name).map(|found| found.discriminating_experiment)
    };
    let experiment = known(one, other).or_else(|| known(other, one));
    experiment.unwrap_or("A different motion, with other speeds and loads.").to_owned()
}

/// Returns the values of a cause with the intervals of its entry in the extended model.
pub fn estimates(hypothesis: &Hypothesis, extended: &ModelFile) -> BTreeMap<String, Estimate> {
    let mut entries = extended.effects.iter().rev();
    let entry = entries.find(|entry| entry.effect == hypothesis.effect && entry.scope == hypothesis.scope);
    let mut estimates = BTreeMap::new();
    let mut place = 0;
    for parameter in hypothesis.effect.parameters {
        let range = place..place + parameter.count;
        place += parameter.count;
        let end = |side: usize| -> Vec<f64> {
            range
                .clone()
                .map(|index| {
                    let interval = entry.and_then(|entry| entry.intervals[index]);
                    interval.map_or(hypothesis.values[index], |interval| interval[side])
                })
                .collect()
        };
        let value = |values: Vec<f64>| {
            if parameter.count == 1 { ParameterValue::Number(values[0]) } else { ParameterValue::Vector(values) }
        };
        let estimate = Estimate {
            value: value(hypothesis.values[range.clone()].to_vec()),
            low: value(end(0)),
            high: value(end(1)),
        };
        estimates.insert(parameter.name.to_owned(), estimate);
    }
    estimates
}

/// Returns a candidate as an alternative hypothesis.
pub fn rival(trial: &CandidateFit) -> AlternativeCause {
    AlternativeCause {
        effect: trial.hypothesis.effect.name.to_owned(),
        scope: trial.hypothesis.scope.to_string(),
        held_out_gain: trial.gain,
    }
}

/// Returns the explanation of a cause as text.
pub fn explanation(best: &CandidateFit, others: &[CandidateFit]) -> String {
    let hypothesis = &best.hypothesis;
    let size = hypothesis.effect.parameters.iter().zip(&hypothesis.values).next();
    let size = size.map_or(String::new(), |(parameter, value)| format!(" of {value:.4} {}", parameter.unit));
    let mut text = format!(
        "{} at {}{}: it reduces the cross-validated RMS error in the affected channels by {:.0} %.",
        hypothesis.effect.name.replace('_', " "),
        hypothesis.scope,
        size.trim_end(),
        100.0 * best.gain
    );
    if let Some(other) = others.first() {
        let behind = best.score - other.score;
        text = format!("{text} Best alternative: {}, {behind:.0} nat less.", other.hypothesis.name());
    }
    text + " " + hypothesis.effect.signature
}

/// Returns a sentence about a size that differs between the halves of the rows; empty if it does not.
pub fn drift(hypothesis: &Hypothesis, values: Option<[f64; 2]>) -> String {
    let Some([first, second]) = values else { return String::new() };
    let unit = hypothesis.effect.parameters[0].unit;
    format!(
        " The size drifts: {first:.4} {unit} in the first half of the log, {second:.4} {unit} in the second. Either the law is not the true one, or the robot changes, as by warming up."
    )
}

/// Returns the RMS errors due to sensor noise alone.
pub fn noise_floor(evidence: &ResidualData) -> RmsErrors {
    let experiments = &evidence.fit_rows.experiments;
    let sigmas = experiments.iter().flat_map(|experiment| {
        experiment.joints().iter().map(|joint| experiment.sigma(ResidualChannel::Position(joint.index())))
    });
    let squares: Vec<f64> = sigmas.map(|sigma| sigma * sigma).collect();
    let has_torque =
        evidence.logs().iter().any(|log| log.joints().iter().any(|joint| log.tau_measured(joint).is_some()));
    let torques: Vec<f64> = evidence
        .logs()
        .iter()
        .flat_map(|log| {
            log.joints().iter().map(|joint| log.noise(&format!("tau_measured_{joint}")).unwrap_or(0.2).powi(2))
        })
        .collect();
    let mean = |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
    RmsErrors { torque_rmse_nm: has_torque.then(|| mean(&torques)), q_rmse_rad: Some(mean(&squares)) }
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};

    use super::*;

    #[test]
    fn interval_includes_the_profile_and_the_mismatch_between_simulators() {
        let interval = |effect: &str, scope: Scope, value: f64, near: [f64; 2]| {
            let effect = Effect::named(effect).expect("an effect of the catalogue");
            let hypothesis = Hypothesis { effect, scope, values: vec![value] };
            let fit = FitProblem::new(&ModelFile::default(), &[hypothesis]).expect("a fit");
            let known = DMatrix::from_element(1, 1, 1e-12);
            let (model, _) = with_intervals(&fit, Some(&known), 0.0, &[near]);
            model.effects[0].intervals[0].expect("an interval")
        };
        let [low, high] = interval("torque_gain", Scope::All, 0.8, [0.8, 0.8]);
        // 1.96 times 1.5 % of the distance from 1, the gain without effect.
        assert!((low - 0.79412).abs() < 1e-6 && (high - 0.80588).abs() < 1e-6, "{low} to {high}");
        let [low, high] = interval("torque_gain", Scope::All, 0.8, [0.7, 0.8]);
        assert!(low == 0.7 && (high - 0.80588).abs() < 1e-6, "{low} to {high}");
        // 1.96 times 4 % of the distance from 0.8, the friction without effect.
        let [low, high] = interval("ground_friction", Scope::Ground, 0.4, [0.4, 0.4]);
        assert!((low - 0.36864).abs() < 1e-6 && (high - 0.43136).abs() < 1e-6, "{low} to {high}");
    }
}
