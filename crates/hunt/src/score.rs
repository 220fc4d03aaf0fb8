//! Score of a diagnosis against the ground truth.

use serde::{Deserialize, Serialize};
use twinstep_diagnose::{Cause, Diagnosis, Estimate, ParameterValue, RmsErrors};
use twinstep_effects::{EffectEntry, Scope};
use twinstep_model::Joint;

use crate::draw::Case;

/// Minimum relative error reduction by the true model. Below it, the reduction by a diagnosis is not scored: noise
/// dominates.
const MIN_REDUCTION: f64 = 0.1;
/// Log-likelihood gain of its true law from which a hidden effect is evident [nat].
pub const LEAST_GAIN: f64 = 10.0;
/// Number of channels of the unexplained residual that are scored, the strongest first.
const STRONGEST: usize = 3;

/// Score of a diagnosis.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Reported causes as `effect@scope`, in the order of the report.
    pub named: Vec<String>,
    /// Score of each hidden effect.
    pub hits: Vec<EffectScore>,
    /// Number of false positives.
    pub wrong_names: usize,
    /// For an effect outside the catalogue: true if the report states what its residual depends on.
    pub depends_on: Option<bool>,
    /// Error reductions on held-out blocks, divided by those of the true model.
    pub removed: ErrorReduction,
}

/// Score of a hidden effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::struct_excessive_bools, reason = "each is a line of the table")]
pub struct EffectScore {
    /// Name of the effect.
    pub effect: String,
    /// Scope of the effect.
    pub scope: String,
    /// True if it is reported as a cause.
    pub named: bool,
    /// True if it is the first cause (top-1 correct).
    pub first: bool,
    /// True if it is not the first cause, but listed as indistinguishable from the first cause.
    pub ambiguous: bool,
    /// True if it is among the first three names, with alternative hypotheses after causes (top-3 correct).
    pub in_top_3: bool,
    /// True if its effect is in the set of names of a cause: the cause and what the log cannot tell apart from it.
    #[serde(default)]
    pub in_set: bool,
    /// Number of effects in that set; of the first cause's set if it is in none.
    #[serde(default)]
    pub set_size: usize,
    /// True if it is reported for the joints where it is hidden, and for no others.
    pub scope_right: bool,
    /// Score of the first parameter, if effect and scope are correct.
    pub size: Option<Size>,
    /// Log-likelihood gain of its true law, refitted with everything else known [nat]. The largest number if the simulation
    /// diverges without it, or the gain cannot be computed.
    pub true_law_gain: f64,
}

impl EffectScore {
    /// Returns true if the effect is evident in its log. Others are listed, and left out of the rates of names and scopes.
    pub fn counts(&self) -> bool {
        self.true_law_gain >= LEAST_GAIN
    }
}

/// Score of an estimated size.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Size {
    /// True if the true value is in the 95 % interval.
    pub covered: bool,
    /// Error, divided by the distance of the true value from no effect.
    pub error: f64,
}

/// Relative error reductions, by quantity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorReduction {
    /// Reduction of the torque error.
    pub torque: Option<f64>,
    /// Reduction of the joint position error in closed loop.
    pub motion: Option<f64>,
}

/// Scores `diagnosis` on `case`. `nominal` and `truth` are the errors of the given and of the true model on its held-out blocks, `gains`
/// the log-likelihood gains of the true laws of the hidden effects [nat].
///
/// A failed diagnosis has reported no cause.
pub fn judge(case: &Case, diagnosis: Option<&Diagnosis>, [nominal, truth]: [RmsErrors; 2], gains: &[f64]) -> Score {
    assert_eq!(case.hidden.len(), gains.len(), "a gain for each hidden effect");
    let findings = diagnosis.map_or(&[][..], |diagnosis| &diagnosis.findings);
    let hidden = |name: &str| case.hidden.iter().any(|entry| entry.effect.name == name);
    let describes = |name: &str| case.mismatch.is_some_and(|mismatch| mismatch.describes(name));
    let depends_on = case.outside.map(|outside| {
        diagnosis.is_some_and(|Diagnosis { unexplained, .. }| {
            let mut texts = unexplained.depends_on.iter().take(STRONGEST).chain([&unexplained.text]);
            texts.any(|text| outside.depends_on(text))
        })
    });
    Score {
        named: findings.iter().map(|cause| format!("{}@{}", cause.effect, cause.scope)).collect(),
        hits: case.hidden.iter().zip(gains).map(|(entry, gain)| hit(entry, *gain, findings)).collect(),
        wrong_names: findings.iter().filter(|cause| !hidden(&cause.effect) && !describes(&cause.effect)).count(),
        depends_on,
        removed: diagnosis.map(|diagnosis| removed(diagnosis, [nominal, truth])).unwrap_or_default(),
    }
}

fn hit(entry: &EffectEntry, gain: f64, findings: &[Cause]) -> EffectScore {
    let name = entry.effect.name;
    let of_name: Vec<_> = findings.iter().filter(|cause| cause.effect == name).collect();
    let first = findings.first().is_some_and(|cause| cause.effect == name);
    let ambiguous = |cause: &Cause| cause.ambiguous_with.iter().any(|other| effect_of(other) == name);
    let set = findings.iter().find(|cause| name_set(cause).contains(&name));
    // One effect may be reported leg by leg.
    let reported: Vec<_> = of_name.iter().flat_map(|cause| joints_of(&cause.scope)).collect();
    let scope_right = !of_name.is_empty() && same(reported, joints_of(&entry.scope.to_string()));
    let exact = of_name.iter().find(|cause| same(joints_of(&cause.scope), joints_of(&entry.scope.to_string())));
    EffectScore {
        effect: name.to_owned(),
        scope: entry.scope.to_string(),
        named: !of_name.is_empty(),
        first,
        ambiguous: !first && findings.first().is_some_and(ambiguous),
        in_set: set.is_some(),
        set_size: set.or(findings.first()).map_or(0, |cause| name_set(cause).len()),
        in_top_3: ranking(findings).iter().take(3).any(|effect| *effect == name),
        scope_right,
        size: exact.and_then(|cause| size(entry, cause.parameters.get(entry.effect.parameters[0].name)?)),
        true_law_gain: gain.min(f64::MAX),
    }
}

/// Returns the effects that the log cannot tell apart from a cause, and the cause's own.
fn name_set(cause: &Cause) -> Vec<&str> {
    let mut names = vec![cause.effect.as_str()];
    for other in &cause.ambiguous_with {
        if !names.contains(&effect_of(other)) {
            names.push(effect_of(other));
        }
    }
    names
}

/// Returns the effects of a report in order, each once: causes, then ambiguous and other alternatives of each.
fn ranking(findings: &[Cause]) -> Vec<&str> {
    let alternatives = findings.iter().flat_map(|cause| {
        let others = cause.rivals.iter().map(|alternative| alternative.effect.as_str());
        cause.ambiguous_with.iter().map(|other| effect_of(other)).chain(others)
    });
    let mut names = Vec::new();
    for name in findings.iter().map(|cause| cause.effect.as_str()).chain(alternatives) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// Returns the effect of a cause such as `armature@calf`.
fn effect_of(cause: &str) -> &str {
    cause.split_once('@').map_or(cause, |(effect, _)| effect)
}

/// Returns the joints of a scope, or the scope itself if it has no joints.
fn joints_of(scope: &str) -> Vec<String> {
    match scope.parse::<Scope>() {
        Ok(scope) if scope.joints() > 0 => {
            Joint::ALL.into_iter().filter(|joint| scope.contains(*joint)).map(|joint| joint.name().to_owned()).collect()
        }
        _ => vec![scope.to_owned()],
    }
}

fn same(mut one: Vec<String>, mut other: Vec<String>) -> bool {
    for joints in [&mut one, &mut other] {
        joints.sort();
        joints.dedup();
    }
    one == other
}

/// Compares the first parameter of a cause with its true value.
fn size(entry: &EffectEntry, found: &Estimate) -> Option<Size> {
    let parameter = &entry.effect.parameters[0];
    let truth = &entry.values[..parameter.count];
    let numbers = |value: &ParameterValue| match value {
        ParameterValue::Number(number) => vec![*number],
        ParameterValue::Vector(numbers) => numbers.clone(),
    };
    let [value, low, high] = [&found.value, &found.low, &found.high].map(numbers);
    if [&value, &low, &high].iter().any(|numbers| numbers.len() != truth.len()) {
        return None;
    }
    let covered = truth.iter().zip(&low).zip(&high).all(|((truth, low), high)| (low..=high).contains(&truth));
    let norm = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|number| number * number).sum::<f64>().sqrt();
    let no_effect = if parameter.no_effect_value.is_finite() { parameter.no_effect_value } else { 0.0 };
    let error = norm(&mut truth.iter().zip(&value).map(|(truth, value)| value - truth));
    Some(Size { covered, error: error / norm(&mut truth.iter().map(|truth| truth - no_effect)) })
}

fn removed(diagnosis: &Diagnosis, [nominal, truth]: [RmsErrors; 2]) -> ErrorReduction {
    let (before, after) = (diagnosis.baseline, diagnosis.extended);
    let share = |of: fn(&RmsErrors) -> Option<f64>| {
        let reduction = |before: &RmsErrors, after: &RmsErrors| Some(1.0 - of(after)? / of(before)?);
        let possible = reduction(&nominal, &truth).filter(|reduction| *reduction >= MIN_REDUCTION)?;
        Some(reduction(&before, &after)? / possible)
    };
    ErrorReduction { torque: share(|errors| errors.torque_rmse_nm), motion: share(|errors| errors.q_rmse_rad) }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use twinstep_diagnose::{AlternativeCause, Unexplained};
    use twinstep_effects::Effect;

    use super::*;
    use crate::base_schedule::BaseSchedule;
    use crate::draw::CaseKind;
    use crate::log_setup::LogSetup;
    use crate::unmodelled::UnmodelledEffect;

    fn case(hidden: &[(&str, &str, f64)]) -> Case {
        let entry = |(name, scope, value): &(&str, &str, f64)| {
            let effect = Effect::named(name).expect("known");
            EffectEntry::new(effect, scope.parse().expect("a scope"), vec![*value]).expect("allowed")
        };
        let setting = LogSetup::with_torque(BaseSchedule::Fixed);
        let hidden = hidden.iter().map(entry).collect();
        Case { seed: 0, number: 0, kind: CaseKind::LargeEffect, setting, hidden, outside: None, mismatch: None }
    }

    fn cause(effect: &str, scope: &str, [low, value, high]: [f64; 3]) -> Cause {
        let name = Effect::named(effect).expect("known").parameters[0].name.to_owned();
        let [low, value, high] = [low, value, high].map(ParameterValue::Number);
        Cause {
            effect: effect.to_owned(),
            scope: scope.to_owned(),
            parameters: BTreeMap::from([(name, Estimate { value, low, high })]),
            held_out_gain: 0.5,
            score_nats: 100.0,
            threshold_nats: 10.0,
            ambiguous_with: Vec::new(),
            posterior: Vec::new(),
            drifts: None,
            remedy: String::new(),
            rivals: Vec::new(),
            evidence: String::new(),
        }
    }

    fn diagnosis(findings: Vec<Cause>) -> Diagnosis {
        Diagnosis {
            decisions: Vec::new(),
            not_reported: Vec::new(),
            promise: None,
            baseline: RmsErrors { torque_rmse_nm: Some(1.0), q_rmse_rad: Some(0.020) },
            extended: RmsErrors { torque_rmse_nm: Some(0.6), q_rmse_rad: Some(0.008) },
            noise_floor: RmsErrors::default(),
            findings,
            joint_gains: BTreeMap::new(),
            also_fitted: Vec::new(),
            confusable: Vec::new(),
            unexplained: Unexplained::default(),
            learned_residual: None,
            next_experiment: None,
            extended_model: "extended.toml".to_owned(),
        }
    }

    fn errors(torque: f64, q: f64) -> RmsErrors {
        RmsErrors { torque_rmse_nm: Some(torque), q_rmse_rad: Some(q) }
    }

    fn scored(case: &Case, findings: Vec<Cause>) -> Score {
        judge(case, Some(&diagnosis(findings)), [errors(1.0, 0.04), errors(0.95, 0.01)], &vec![50.0; case.hidden.len()])
    }

    #[test]
    fn correct_cause_with_scope_and_size_meets_all_criteria() {
        let case = case(&[("torque_gain", "RR_calf", 1.2)]);
        let verdict = scored(&case, vec![cause("torque_gain", "RR_calf", [1.15, 1.18, 1.21])]);
        let hit = &verdict.hits[0];
        assert!(hit.first && hit.in_top_3 && hit.scope_right && hit.named && !hit.ambiguous);
        let size = hit.size.expect("compared");
        assert!(size.covered && (size.error - 0.1).abs() < 1e-9, "the size of a gain is its distance from one");
        assert_eq!((verdict.named[0].as_str(), verdict.wrong_names), ("torque_gain@RR_calf", 0));
    }

    #[test]
    fn effect_counts_from_ten_nat() {
        let case = case(&[("torque_gain", "RR_calf", 1.2)]);
        let counts = |gain: f64| {
            let hit = &judge(&case, None, [errors(1.0, 0.04); 2], &[gain]).hits[0];
            let line = serde_json::to_string(hit).expect("a line");
            assert_eq!(serde_json::from_str::<EffectScore>(&line).expect("read again"), *hit);
            hit.counts()
        };
        assert_eq!([0.0, 9.99, 10.0, f64::INFINITY].map(counts), [false, false, true, true]);
    }

    #[test]
    fn legs_reported_one_by_one_count_as_their_side() {
        let case = case(&[("coulomb_friction", "left", 0.5)]);
        let of = |scope| cause("coulomb_friction", scope, [0.4, 0.5, 0.6]);
        assert!(scored(&case, vec![of("FL"), of("RL")]).hits[0].scope_right);
        let half = &scored(&case, vec![of("FL")]).hits[0];
        assert!(half.first && !half.scope_right && half.size.is_none());
    }

    #[test]
    fn alternative_of_a_false_positive_is_top_3_but_not_top_1() {
        let case = case(&[("torque_delay", "all", 0.008)]);
        let mut wrong = cause("command_delay", "all", [0.0, 0.008, 0.01]);
        wrong.ambiguous_with = vec!["torque_delay@all".to_owned()];
        let verdict = scored(&case, vec![wrong.clone()]);
        let hit = &verdict.hits[0];
        assert!(!hit.first && !hit.named && hit.ambiguous && hit.in_top_3 && verdict.wrong_names == 1);
        wrong.ambiguous_with.clear();
        wrong.rivals =
            vec![AlternativeCause { effect: "torque_delay".to_owned(), scope: "all".to_owned(), held_out_gain: 0.1 }];
        let hit = &scored(&case, vec![wrong]).hits[0];
        assert!(!hit.ambiguous && hit.in_top_3);
    }

    #[test]
    fn any_cause_is_a_false_positive_without_a_hidden_catalogue_effect() {
        let mut other = case(&[]);
        assert_eq!(scored(&other, vec![cause("armature", "all", [0.0; 3])]).wrong_names, 1);
        other.outside = Some(UnmodelledEffect::OneWayFriction { joint: 0, torque: 1.0 });
        let mut diagnosis = diagnosis(Vec::new());
        let scored = |diagnosis: &Diagnosis| judge(&other, Some(diagnosis), [errors(1.0, 0.04); 2], &[]);
        assert_eq!(scored(&diagnosis).depends_on, Some(false));
        diagnosis.unexplained.depends_on = vec!["q_cmd_FL_hip".to_owned()];
        assert_eq!(scored(&diagnosis).depends_on, Some(true));
    }

    #[test]
    fn error_reduction_is_relative_to_that_of_the_true_model() {
        let verdict = scored(&case(&[]), Vec::new());
        assert!((verdict.removed.motion.expect("known") - 0.6 / 0.75).abs() < 1e-9);
        assert_eq!(verdict.removed.torque, None, "the reduction by the true model is too small");
    }
}
