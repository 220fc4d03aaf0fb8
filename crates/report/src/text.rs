//! Names of effects and scopes, and the headline of the report. Text from files is escaped here.

use twinstep_diagnose::{Cause, Diagnosis, ParameterValue, RmsErrors};
use twinstep_effects::{Effect, Target};

use crate::html::{alike, escape, percent};

/// Unexplained fraction of the residual power above noise that is reported as no error.
const NEGLIGIBLE_FRACTION: f64 = 0.1;

/// Returns the name of an effect in words.
pub fn effect(name: &str) -> String {
    let words = escape(&name.replace('_', " "));
    words.replace("coulomb", "Coulomb").replace("stribeck", "Stribeck").replace("com shift", "centre-of-mass shift")
}

/// Returns a scope in words, for use after "of".
pub fn scope(scope: &str) -> String {
    match scope {
        "all" => "all joints".to_owned(),
        "hip" | "thigh" => format!("the {scope}s"),
        "calf" => "the calves".to_owned(),
        "FL" | "FR" | "RL" | "RR" => format!("leg {scope}"),
        "left" | "right" => format!("the {scope} legs"),
        "base" => "the base".to_owned(),
        "ground" => "the ground".to_owned(),
        other => escape(other),
    }
}

/// Returns an effect with its scope in words.
pub fn cause(name: &str, about: &str) -> String {
    match Effect::named(name).map(|effect| effect.target) {
        // The scope of these effects adds no information: "ground friction of the ground".
        Some(Target::Ground | Target::Supply) => effect(name),
        _ => format!("{} of {}", effect(name), scope(about)),
    }
}

/// Returns a cause in words, from its form `armature@calf` in findings.
pub fn cause_at(text: &str) -> String {
    text.split_once('@').map_or_else(|| effect(text), |(name, about)| cause(name, about))
}

/// Returns text in which every second part between backticks is code.
pub fn with_code(text: &str) -> String {
    let part = |(index, part): (usize, &str)| {
        if index % 2 == 1 { format!("<code>{}</code>", escape(part)) } else { escape(part) }
    };
    text.split('`').enumerate().map(part).collect()
}

/// Capitalises the first letter.
pub fn sentence(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// Returns the headline: a summary of the diagnosis.
pub fn verdict(diagnosis: &Diagnosis) -> String {
    let Diagnosis { findings, unexplained, baseline, extended, .. } = diagnosis;
    if findings.is_empty() {
        return match unexplained.depends_on.split_first() {
            None if unexplained.fraction < NEGLIGIBLE_FRACTION && !diagnosis.joint_gains.is_empty() => {
                "No cause: the gains differ from joint to joint by a few percent, as those of equal motors.".to_owned()
            }
            None if unexplained.fraction < NEGLIGIBLE_FRACTION => "No model error above the noise.".to_owned(),
            None => format!(
                "The model has an error, but no cause reaches the threshold: {} of the residual power is unexplained.",
                percent(unexplained.fraction)
            ),
            Some(_) => format!(
                "The model has an error that no effect of the catalogue explains; it depends on {}.",
                listed(unexplained.depends_on.iter().map(|channel| format!("<code>{}</code>", escape(channel))))
            ),
        };
    }
    let causes = listed(findings.iter().enumerate().map(|(index, finding)| {
        let name = cause(&finding.effect, &finding.scope);
        format!("<strong>{}</strong>{}", if index == 0 { sentence(&name) } else { name }, size(finding))
    }));
    let together = if findings.len() > 1 { "; together they remove " } else { ": it removes " };
    let removed = removed(baseline, extended);
    let gain = if removed.is_empty() { String::new() } else { format!("{together}{removed}") };
    format!("{causes}{gain}.{}", findings.iter().map(ambiguity).collect::<String>())
}

/// Returns the first parameter with its interval in brackets, if it is a single number.
fn size(finding: &Cause) -> String {
    let parameters = Effect::named(&finding.effect).map_or(&[][..], |effect| effect.parameters);
    let first = parameters.first().and_then(|first| finding.parameters.get(first.name).map(|value| (first, value)));
    let Some((parameter, estimate)) = first else { return String::new() };
    match (&estimate.value, &estimate.low, &estimate.high) {
        (ParameterValue::Number(value), ParameterValue::Number(low), ParameterValue::Number(high)) => {
            let [value, low, high] = alike([*value, *low, *high]);
            format!(" ({}, 95 %: {low} to {high})", format!("{value} {}", parameter.unit).trim_end())
        }
        _ => String::new(),
    }
}

/// Returns a sentence with the ambiguous alternatives of a cause.
fn ambiguity(finding: &Cause) -> String {
    if finding.ambiguous_with.is_empty() {
        return String::new();
    }
    let others = listed(finding.ambiguous_with.iter().map(|other| cause_at(other)));
    format!(" With this log, {} is not distinguishable from {others}.", cause(&finding.effect, &finding.scope))
}

fn removed(baseline: &RmsErrors, extended: &RmsErrors) -> String {
    let pairs = [
        ("joint position error", "rad", baseline.q_rmse_rad, extended.q_rmse_rad),
        ("torque error", "N·m", baseline.torque_rmse_nm, extended.torque_rmse_nm),
    ];
    let known = pairs.into_iter().filter_map(|(what, unit, before, after)| {
        let (before, after) = before.zip(after)?;
        let share = gain(before, after)?;
        let [before, after] = alike([before, after]);
        Some(format!("{} of the {what} ({before} → {after} {unit})", percent(share)))
    });
    listed(known)
}

/// Returns the relative reduction, 1 − after / before. Returns `None` if it is not defined.
pub fn gain(before: f64, after: f64) -> Option<f64> {
    (before > 0.0 && after.is_finite()).then(|| 1.0 - after / before)
}

/// Joins items as in "a, b and c".
pub fn listed(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    match items.split_last() {
        None => String::new(),
        Some((only, [])) => only.clone(),
        Some((last, rest)) => format!("{} and {last}", rest.join(", ")),
    }
}
