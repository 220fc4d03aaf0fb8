//! What a diagnosis said, against what was hidden.

use serde::{Deserialize, Serialize};
use twinstep_diagnose::{Cause, Diagnosis, Estimate, ParameterValue, RmsErrors};
use twinstep_effects::{EffectEntry, Scope};
use twinstep_model::Joint;

use crate::draw::Case;

/// The least share of an error that the truth must remove [1] for the share of a diagnosis to be asked for: of less, noise
/// decides.
const LEAST_REMOVED: f64 = 0.1;
/// Channels of what is left that count, from the strongest.
const STRONGEST: usize = 3;

/// What a diagnosis was worth.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// What it named, as `effect@scope`, in its order.
    pub named: Vec<String>,
    /// For each hidden effect, how it was found.
    pub hits: Vec<EffectScore>,
    /// Names that were not hidden.
    pub wrong_names: usize,
    /// Of what is outside the catalogue: whether what it depends on was said.
    pub depends_on: Option<bool>,
    /// Shares of the error that it removed on rows held out, of what the truth in our own model removes.
    pub removed: ErrorReduction,
}

/// How a hidden effect was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::struct_excessive_bools, reason = "each is a line of the table")]
pub struct EffectScore {
    /// Its name.
    pub effect: String,
    /// What it was about.
    pub scope: String,
    /// Named, in whatever place.
    pub named: bool,
    /// Named first.
    pub first: bool,
    /// Not named first, but said to be as likely as what was.
    pub ambiguous: bool,
    /// Among the first three names, those of rivals after those of causes.
    pub in_top_3: bool,
    /// Named, on the joints where it was hidden and no others.
    pub scope_right: bool,
    /// Of the first parameter, where name and scope are right.
    pub size: Option<Size>,
}

/// How well a size was found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Size {
    /// Whether it lies in its 95 % interval.
    pub covered: bool,
    /// Of what the effect adds to nothing, relative.
    pub error: f64,
}

/// Shares of an error, by where it is seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorReduction {
    /// Of the torque's.
    pub torque: Option<f64>,
    /// Of the motion's, in closed loop.
    pub motion: Option<f64>,
}

/// Judges what `diagnosis` says of `case`; `nominal` and `truth` are the errors of the model that it was given and of the
/// true one on the same log.
///
/// A diagnosis that gave no answer named nothing.
pub fn judge(case: &Case, diagnosis: Option<&Diagnosis>, [nominal, truth]: [RmsErrors; 2]) -> Score {
    let findings = diagnosis.map_or(&[][..], |diagnosis| &diagnosis.findings);
    let hidden = |name: &str| case.hidden.iter().any(|entry| entry.effect.name == name);
    let depends_on = case.outside.map(|outside| {
        diagnosis.is_some_and(|Diagnosis { unexplained, .. }| {
            let mut told = unexplained.depends_on.iter().take(STRONGEST).chain([&unexplained.text]);
            told.any(|told| outside.depends_on(told))
        })
    });
    Score {
        named: findings.iter().map(|cause| format!("{}@{}", cause.effect, cause.scope)).collect(),
        hits: case.hidden.iter().map(|entry| hit(entry, findings)).collect(),
        wrong_names: findings.iter().filter(|cause| !hidden(&cause.effect)).count(),
        depends_on,
        removed: diagnosis.map(|said| removed(said, [nominal, truth])).unwrap_or_default(),
    }
}

fn hit(entry: &EffectEntry, findings: &[Cause]) -> EffectScore {
    let name = entry.effect.name;
    let of_name: Vec<_> = findings.iter().filter(|cause| cause.effect == name).collect();
    let first = findings.first().is_some_and(|cause| cause.effect == name);
    let ambiguous = |cause: &Cause| cause.ambiguous_with.iter().any(|told| effect_of(told) == name);
    // One effect may be named leg by leg.
    let together: Vec<_> = of_name.iter().flat_map(|cause| places(&cause.scope)).collect();
    let scope_right = !of_name.is_empty() && same(together, places(&entry.scope.to_string()));
    let alone = of_name.iter().find(|cause| same(places(&cause.scope), places(&entry.scope.to_string())));
    EffectScore {
        effect: name.to_owned(),
        scope: entry.scope.to_string(),
        named: !of_name.is_empty(),
        first,
        ambiguous: !first && findings.first().is_some_and(ambiguous),
        in_top_3: ranking(findings).iter().take(3).any(|told| *told == name),
        scope_right,
        size: alone.and_then(|cause| size(entry, cause.parameters.get(entry.effect.parameters[0].name)?)),
    }
}

/// Names in the order in which a reader takes them for the cause: causes, then what each could also be, each once.
fn ranking(findings: &[Cause]) -> Vec<&str> {
    let also = findings.iter().flat_map(|cause| {
        let rivals = cause.rivals.iter().map(|rival| rival.effect.as_str());
        cause.ambiguous_with.iter().map(|told| effect_of(told)).chain(rivals)
    });
    let mut names = Vec::new();
    for name in findings.iter().map(|cause| cause.effect.as_str()).chain(also) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// The effect of `armature@calf`.
fn effect_of(told: &str) -> &str {
    told.split_once('@').map_or(told, |(effect, _)| effect)
}

/// The joints of a scope, or the part of the robot that it is.
fn places(scope: &str) -> Vec<String> {
    match scope.parse::<Scope>() {
        Ok(scope) if scope.joints() > 0 => {
            Joint::ALL.into_iter().filter(|joint| scope.contains(*joint)).map(|joint| joint.name().to_owned()).collect()
        }
        _ => vec![scope.to_owned()],
    }
}

fn same(mut one: Vec<String>, mut other: Vec<String>) -> bool {
    for places in [&mut one, &mut other] {
        places.sort();
        places.dedup();
    }
    one == other
}

/// The first parameter of a finding against the hidden one's.
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
    let within = truth.iter().zip(&low).zip(&high).all(|((truth, low), high)| (low..=high).contains(&truth));
    let norm = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|number| number * number).sum::<f64>().sqrt();
    let nothing = if parameter.no_effect_value.is_finite() { parameter.no_effect_value } else { 0.0 };
    let missed = norm(&mut truth.iter().zip(&value).map(|(truth, value)| value - truth));
    Some(Size { covered: within, error: missed / norm(&mut truth.iter().map(|truth| truth - nothing)) })
}

fn removed(diagnosis: &Diagnosis, [nominal, truth]: [RmsErrors; 2]) -> ErrorReduction {
    let (before, after) = (diagnosis.baseline, diagnosis.extended);
    let share = |of: fn(&RmsErrors) -> Option<f64>| {
        let share_gone = |before: &RmsErrors, after: &RmsErrors| Some(1.0 - of(after)? / of(before)?);
        let possible = share_gone(&nominal, &truth).filter(|gone| *gone >= LEAST_REMOVED)?;
        Some(share_gone(&before, &after)? / possible)
    };
    ErrorReduction { torque: share(|errors| errors.torque_rmse_nm), motion: share(|errors| errors.q_rmse_rad) }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use twinstep_diagnose::{AlternativeCause, Unexplained};
    use twinstep_effects::Effect;

    use super::*;
    use crate::draw::{BaseSchedule, CaseKind, LogSetup};
    use crate::unmodelled::UnmodelledEffect;

    fn case(hidden: &[(&str, &str, f64)]) -> Case {
        let entry = |(name, scope, value): &(&str, &str, f64)| {
            let effect = Effect::named(name).expect("known");
            EffectEntry::new(effect, scope.parse().expect("a scope"), vec![*value]).expect("allowed")
        };
        let setting = LogSetup { place: BaseSchedule::Fixed, torque: true, battery: false, temperature: false };
        let hidden = hidden.iter().map(entry).collect();
        Case { seed: 0, number: 0, kind: CaseKind::LargeEffect, setting, hidden, outside: None }
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
            rivals: Vec::new(),
            evidence: String::new(),
        }
    }

    fn said(findings: Vec<Cause>) -> Diagnosis {
        Diagnosis {
            baseline: RmsErrors { torque_rmse_nm: Some(1.0), q_rmse_rad: Some(0.020) },
            extended: RmsErrors { torque_rmse_nm: Some(0.6), q_rmse_rad: Some(0.008) },
            noise_floor: RmsErrors::default(),
            findings,
            confusable: Vec::new(),
            unexplained: Unexplained::default(),
            next_experiment: None,
            extended_model: "extended.toml".to_owned(),
        }
    }

    fn errors(torque: f64, q: f64) -> RmsErrors {
        RmsErrors { torque_rmse_nm: Some(torque), q_rmse_rad: Some(q) }
    }

    fn judged(case: &Case, findings: Vec<Cause>) -> Score {
        judge(case, Some(&said(findings)), [errors(1.0, 0.04), errors(0.95, 0.01)])
    }

    #[test]
    fn right_name_with_its_joints_and_size_is_a_hit() {
        let case = case(&[("torque_gain", "RR_calf", 1.2)]);
        let verdict = judged(&case, vec![cause("torque_gain", "RR_calf", [1.15, 1.18, 1.21])]);
        let hit = &verdict.hits[0];
        assert!(hit.first && hit.in_top_3 && hit.scope_right && hit.named && !hit.ambiguous);
        let size = hit.size.expect("compared");
        assert!(size.covered && (size.error - 0.1).abs() < 1e-9, "a gain's size is what it adds to one");
        assert_eq!((verdict.named[0].as_str(), verdict.wrong_names), ("torque_gain@RR_calf", 0));
    }

    #[test]
    fn legs_named_one_by_one_are_the_side_that_they_make() {
        let case = case(&[("coulomb_friction", "left", 0.5)]);
        let of = |scope| cause("coulomb_friction", scope, [0.4, 0.5, 0.6]);
        assert!(judged(&case, vec![of("FL"), of("RL")]).hits[0].scope_right);
        let half = &judged(&case, vec![of("FL")]).hits[0];
        assert!(half.first && !half.scope_right && half.size.is_none());
    }

    #[test]
    fn truth_beside_a_wrong_name_counts_strictly_and_as_said() {
        let case = case(&[("torque_delay", "all", 0.008)]);
        let mut wrong = cause("command_delay", "all", [0.0, 0.008, 0.01]);
        wrong.ambiguous_with = vec!["torque_delay@all".to_owned()];
        let verdict = judged(&case, vec![wrong.clone()]);
        let hit = &verdict.hits[0];
        assert!(!hit.first && !hit.named && hit.ambiguous && hit.in_top_3 && verdict.wrong_names == 1);
        wrong.ambiguous_with.clear();
        wrong.rivals =
            vec![AlternativeCause { effect: "torque_delay".to_owned(), scope: "all".to_owned(), held_out_gain: 0.1 }];
        let hit = &judged(&case, vec![wrong]).hits[0];
        assert!(!hit.ambiguous && hit.in_top_3);
    }

    #[test]
    fn any_name_is_wrong_where_nothing_or_something_else_is_hidden() {
        let mut other = case(&[]);
        assert_eq!(judged(&other, vec![cause("armature", "all", [0.0; 3])]).wrong_names, 1);
        other.outside = Some(UnmodelledEffect::OneWayFriction { joint: 0, torque: 1.0 });
        let mut diagnosis = said(Vec::new());
        let judged = |diagnosis: &Diagnosis| judge(&other, Some(diagnosis), [errors(1.0, 0.04); 2]);
        assert_eq!(judged(&diagnosis).depends_on, Some(false));
        diagnosis.unexplained.depends_on = vec!["q_cmd_FL_hip".to_owned()];
        assert_eq!(judged(&diagnosis).depends_on, Some(true));
    }

    #[test]
    fn removed_error_is_a_share_of_what_the_truth_removes() {
        let verdict = judged(&case(&[]), Vec::new());
        assert!((verdict.removed.motion.expect("known") - 0.6 / 0.75).abs() < 1e-9);
        assert_eq!(verdict.removed.torque, None, "the truth removes too little of it");
    }
}
