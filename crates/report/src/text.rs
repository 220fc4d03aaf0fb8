//! Effects, scopes and the verdict in a robot engineer's words. What comes from files is escaped here.

use twinstep_diagnose::{Cause, Diagnosis, ParameterValue, RmsErrors};
use twinstep_effects::{Effect, Target};

use crate::html::{alike, escape, percent};

/// Below this share of the residual power above the noise, what is left is not worth a word.
const NOTHING_LEFT: f64 = 0.1;

/// An effect's name as people write it.
pub fn effect(name: &str) -> String {
    let words = escape(&name.replace('_', " "));
    words.replace("coulomb", "Coulomb").replace("stribeck", "Stribeck").replace("com shift", "centre-of-mass shift")
}

/// What an effect is about, after "of".
pub fn scope(scope: &str) -> String {
    match scope {
        "all" => "all joints".to_owned(),
        "hip" | "thigh" => format!("the {scope}s"),
        "calf" => "the calves".to_owned(),
        "FL" | "FR" | "RL" | "RR" => format!("leg {scope}"),
        "left" | "right" => format!("the {scope} legs"),
        "base" => "the trunk".to_owned(),
        "ground" => "the ground".to_owned(),
        other => escape(other),
    }
}

/// An effect with its scope.
pub fn cause(name: &str, about: &str) -> String {
    match Effect::named(name).map(|effect| effect.target) {
        // "Ground friction of the ground" says nothing more.
        Some(Target::Ground | Target::Supply) => effect(name),
        _ => format!("{} of {}", effect(name), scope(about)),
    }
}

/// As `armature@calf` is written in findings.
pub fn cause_at(text: &str) -> String {
    text.split_once('@').map_or_else(|| effect(text), |(name, about)| cause(name, about))
}

/// With a capital letter.
pub fn sentence(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// What the diagnosis comes to, in a sentence.
pub fn verdict(diagnosis: &Diagnosis) -> String {
    let Diagnosis { findings, unexplained, baseline, extended, .. } = diagnosis;
    if findings.is_empty() {
        return match unexplained.depends_on.split_first() {
            None if unexplained.fraction < NOTHING_LEFT => "Nothing is wrong above the noise.".to_owned(),
            None => format!(
                "Something is wrong, but no cause earns its name: {} of the error above the noise is unexplained.",
                percent(unexplained.fraction)
            ),
            Some(_) => format!(
                "Something is wrong that no effect of the catalogue explains; it depends on {}.",
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

/// The first parameter, in brackets, where it is one number.
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

/// What a finding cannot be told from.
fn ambiguity(finding: &Cause) -> String {
    if finding.ambiguous_with.is_empty() {
        return String::new();
    }
    let others = listed(finding.ambiguous_with.iter().map(|other| cause_at(other)));
    format!(" This log cannot tell {} from {others}.", cause(&finding.effect, &finding.scope))
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

/// 1 − after / before.
pub fn gain(before: f64, after: f64) -> Option<f64> {
    (before > 0.0 && after.is_finite()).then(|| 1.0 - after / before)
}

/// "a, b and c".
pub fn listed(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    match items.split_last() {
        None => String::new(),
        Some((only, [])) => only.clone(),
        Some((last, rest)) => format!("{} and {last}", rest.join(", ")),
    }
}
