//! Findings of a report from the causes that explain a log.

use std::collections::BTreeMap;

use twinstep_effects::Effect;
use twinstep_inference::equations::{Explained, Explanation, LawTerm as Term, Passed, UnknownLaw};

use super::findings::{
    AlternativeCause, Cause, CorrelatedPair, Estimate, LawTerm, NotReported, ParameterValue, Unexplained,
    WeightedHypothesis,
};

/// Evidence by which a cause must be better than without it [nat].
const LEAST_GAIN: f64 = 3.0;
/// Evidence by which a rival may be worse than a cause, and still be as good an explanation: odds of 20 to 1 [nat].
pub const AMBIGUOUS: f64 = 3.0;
/// Standard deviations of a normal distribution within which 95 % are.
const TWO_SIDED_95: f64 = 1.96;
/// Absolute correlation of two estimates from which they are reported.
const CORRELATED: f64 = 0.9;

/// Share of the squared errors above the noise from which what is left is reported.
const LEAST_LEFT: f64 = 0.02;

/// Returns the strongest law that the catalogue does not have.
pub fn unexplained_law(found: &Explained) -> Unexplained {
    let Some(UnknownLaw { joint, quantity, variable, terms, gain }) = found.unknown.first() else {
        if !found.is_of_positions || found.left < LEAST_LEFT {
            return only_noise();
        }
        let text = format!(
            "The causes leave {:.0} % of the squared position errors above the noise. Torques are not measured, so that their law is not \
             looked for.",
            100.0 * found.left
        );
        return Unexplained { fraction: found.left, text, ..Unexplained::default() };
    };
    let channel = if *variable == "t" { "t".to_owned() } else { format!("{variable}_{joint}") };
    let others = found.unknown.len() - 1;
    let more = if others == 0 { String::new() } else { format!(" So do {others} more equations.") };
    let law: Vec<LawTerm> = terms.iter().map(law_term).collect();
    let sum = sum(&law);
    let form = if sum.is_empty() { format!("its size changes with {channel}") } else { format!("it is {sum}") };
    let text = format!(
        "The {quantity} of {joint} has another law, which the catalogue does not have: {form}. It explains {gain:.0} nat.{more}"
    );
    Unexplained { fraction: found.left, depends_on: vec![channel], law, text }
}

fn law_term(term: &Term) -> LawTerm {
    let half = TWO_SIDED_95 * term.std;
    LawTerm {
        formula: term.formula.clone(),
        coefficient: term.coefficient,
        torque_nm: term.torque,
        interval: [term.torque - half, term.torque + half],
    }
}

/// Returns a law as a formula.
fn sum(law: &[LawTerm]) -> String {
    let term = |(index, term): (usize, &LawTerm)| {
        let sign = match (index, term.coefficient < 0.0) {
            (0, false) => "",
            (0, true) => "-",
            (_, false) => " + ",
            (_, true) => " - ",
        };
        format!("{sign}{} {}", significant(term.coefficient.abs()), term.formula)
    };
    law.iter().enumerate().map(term).collect()
}

/// Returns a number with three significant digits.
fn significant(number: f64) -> String {
    let digits = 2 - number.abs().max(1e-12).log10().floor() as i32;
    format!("{number:.*}", digits.max(0) as usize)
}

/// Returns the result for a residual that does not exceed noise.
fn only_noise() -> Unexplained {
    Unexplained { text: "The residual is noise.".to_owned(), ..Unexplained::default() }
}

/// Returns why the effects that are no cause are none.
pub fn not_reported(found: &Explained) -> Vec<NotReported> {
    let of = |passed: &Passed| NotReported {
        effect: passed.effect.name.to_owned(),
        scope: passed.best.as_ref().map(|(scope, _)| scope.clone()),
        gain_nats: passed.best.as_ref().map(|(_, gain)| *gain),
        reason: passed.reason.to_owned(),
    };
    found.passed.iter().map(of).collect()
}

/// Returns the experiment that discriminates between two effects.
fn experiment_between(one: &Effect, other: &Effect) -> String {
    let known = |from: &Effect, to: &Effect| {
        let mut confounders = from.confounders.iter();
        confounders.find(|confounder| confounder.effect == to.name).map(|found| found.discriminating_experiment)
    };
    let experiment = known(one, other).or_else(|| known(other, one));
    experiment.unwrap_or("A different motion, with other speeds and loads.").to_owned()
}

/// Returns the entries of the extended model that are no cause. `joints` are the names of the robot's joints.
pub fn also_fitted(found: &Explained, joints: &[String]) -> Vec<String> {
    let entries = |one: &Explanation| -> Vec<String> {
        let name = |scope: &str| format!("{}@{scope}", one.effect.name);
        if one.by_joint.is_empty() {
            return vec![name(&one.scope)];
        }
        one.by_joint.iter().map(|own| name(&joints[own.joint])).collect()
    };
    found.unnamed.iter().flat_map(entries).collect()
}

/// Returns the pairs of causes whose estimates are highly correlated.
pub fn confusable(found: &Explained) -> Vec<CorrelatedPair> {
    let is_high = |(one, other, correlation): &&(usize, usize, f64)| {
        correlation.abs() >= CORRELATED && found.causes[*one].effect != found.causes[*other].effect
    };
    let pair = |(one, other, correlation): &(usize, usize, f64)| {
        let [one, other] = [*one, *other].map(|index| found.causes[index].effect);
        CorrelatedPair {
            effects: [one.name.to_owned(), other.name.to_owned()],
            correlation: *correlation,
            experiment: experiment_between(one, other),
        }
    };
    found.correlations.iter().filter(is_high).map(pair).collect()
}

/// Returns the finding of a cause. `joints` are the names of the robot's joints.
pub fn finding(cause: &Explanation, joints: &[String]) -> Cause {
    let close: Vec<_> = cause.rivals.iter().filter(|(.., behind)| *behind > -AMBIGUOUS).collect();
    let total = 1.0 + close.iter().map(|(.., behind)| behind.exp()).sum::<f64>();
    let weighted = |effect: &Effect, scope: &str, weight: f64| WeightedHypothesis {
        effect: effect.name.to_owned(),
        scope: scope.to_owned(),
        probability: weight / total,
    };
    let of_rivals = close.iter().map(|(effect, scope, _, behind)| weighted(effect, scope, behind.exp()));
    let rival = |(effect, scope, ..): &&(&Effect, String, Vec<f64>, f64)| AlternativeCause {
        effect: effect.name.to_owned(),
        scope: scope.clone(),
        held_out_gain: cause.explained,
    };
    Cause {
        effect: cause.effect.name.to_owned(),
        scope: cause.scope.clone(),
        parameters: estimates(cause),
        held_out_gain: cause.explained,
        score_nats: cause.gain,
        threshold_nats: LEAST_GAIN,
        ambiguous_with: close.iter().map(|(effect, scope, ..)| format!("{}@{scope}", effect.name)).collect(),
        posterior: std::iter::once(weighted(cause.effect, &cause.scope, 1.0)).chain(of_rivals).collect(),
        drifts: None,
        remedy: cause.effect.remedy.to_owned(),
        rivals: close.iter().map(rival).collect(),
        evidence: evidence(cause, joints),
    }
}

/// Returns the estimates of the parameters, by name.
fn estimates(cause: &Explanation) -> BTreeMap<String, Estimate> {
    let mut place = 0;
    let mut estimates = BTreeMap::new();
    for parameter in cause.effect.parameters {
        let range = place..place + parameter.count;
        place = range.end;
        let of = |number: &dyn Fn(usize) -> f64| {
            let all: Vec<f64> = range.clone().map(number).collect();
            if let [one] = all.as_slice() { ParameterValue::Number(*one) } else { ParameterValue::Vector(all) }
        };
        let estimate = Estimate {
            value: of(&|index| cause.values[index]),
            low: of(&|index| cause.intervals[index][0]),
            high: of(&|index| cause.intervals[index][1]),
        };
        estimates.insert(parameter.name.to_owned(), estimate);
    }
    estimates
}

/// Returns why a cause is reported, as sentences.
fn evidence(cause: &Explanation, joints: &[String]) -> String {
    let first = &cause.effect.parameters[0];
    let size = format!("{:.4} {}", cause.values[0], first.unit);
    let name = cause.effect.name.replace('_', " ");
    let mut evidence = format!(
        "{name} at {}, {} {}: without it, the other causes explain the log {:.0} nat less.",
        cause.scope,
        first.name,
        size.trim_end(),
        cause.gain
    );
    if let Some((effect, scope, _, behind)) = cause.rivals.first() {
        let rival = effect.name.replace('_', " ");
        evidence = format!("{evidence} In its place, {rival} at {scope} is {:.0} nat behind.", -behind);
    }
    if !cause.by_joint.is_empty() {
        let all: Vec<String> =
            cause.by_joint.iter().map(|own| format!("{} {:.3}", joints[own.joint], own.values[0])).collect();
        evidence = format!("{evidence} Each joint has its own: {}.", all.join(", "));
    }
    evidence + " " + cause.effect.signature
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn law_is_a_formula_with_three_significant_digits() {
        let term = |coefficient, formula: &str| LawTerm {
            formula: formula.to_owned(),
            coefficient,
            torque_nm: 1.0,
            interval: [0.9, 1.1],
        };
        assert_eq!(sum(&[term(-0.19234, "tau"), term(-1234.5, "dq"), term(4.0, "1")]), "-0.192 tau - 1234 dq + 4.00 1");
    }
}
