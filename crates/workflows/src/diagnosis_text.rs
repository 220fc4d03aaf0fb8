//! Summary of a diagnosis for a terminal.

use std::path::Path;

use twinstep_diagnose::{Diagnosis, ParameterValue, Promise, RmsErrors};

use crate::ambiguous_effects;

/// Returns the summary of a diagnosis in the folder `out`.
pub fn text(diagnosis: &Diagnosis, out: &Path) -> String {
    let mut lines = Vec::new();
    for cause in &diagnosis.findings {
        let sizes = cause.parameters.iter().map(|(name, estimate)| {
            let numbers = [&estimate.value, &estimate.low, &estimate.high].map(number);
            format!("{name} {} ({} to {})", numbers[0], numbers[1], numbers[2])
        });
        lines.push(format!("{}@{}  {}", cause.effect, cause.scope, sizes.collect::<Vec<_>>().join(", ")));
        lines.push(format!("    {}", cause.evidence));
        lines.push(format!("    {}", cause.remedy));
        if !cause.ambiguous_with.is_empty() {
            lines.push(format!("    not distinguishable from {} with this log", cause.ambiguous_with.join(" or ")));
        }
    }
    if diagnosis.findings.is_empty() {
        lines.push("no cause identified".to_owned());
    }
    lines.extend(joint_gains(diagnosis));
    if !diagnosis.also_fitted.is_empty() && !diagnosis.extended_model.is_empty() {
        lines.push(format!(
            "{} also has {} entries that are too small or too uncertain for a name: `also_fitted` in findings.json",
            diagnosis.extended_model,
            diagnosis.also_fitted.len()
        ));
    }
    lines.push(diagnosis.unexplained.text.clone());
    if let Some(learned) = &diagnosis.learned_residual {
        lines.push(format!(
            "{}  learned from {:.1} N·m and {:.1} rad/s at most; `extended.toml` adds its torque at `{}`",
            learned.ensemble, learned.max_torque_nm, learned.max_speed_rad_s, learned.tap
        ));
    }
    if let Some(next) = &diagnosis.next_experiment {
        lines.push(format!("next experiment: {}", out.join(&next.motion).display()));
        lines.push(format!("    {}", next.text));
    }
    let unknowns = ambiguous_effects::names(diagnosis);
    if !unknowns.is_empty() && diagnosis.findings.iter().any(|cause| !cause.ambiguous_with.is_empty()) {
        let command =
            format!("twinstep excite data/policies/walk.safetensors --findings {} --out design", out.display());
        lines.push(format!("next experiment of a walking robot, about {}: {command}", unknowns.join(", ")));
    }
    lines.push(error_line("closed-loop joint RMSE [rad]", diagnosis, |errors| errors.q_rmse_rad));
    lines.extend(diagnosis.promise.as_ref().map(promise));
    lines.push(error_line("torque RMSE [N·m]", diagnosis, |errors| errors.torque_rmse_nm));
    lines.join("\n") + "\n"
}

/// Returns why causes were added, changed or removed, and why every other effect of the catalogue is no cause.
pub fn why(diagnosis: &Diagnosis) -> String {
    let mut lines = vec!["Decisions, with the evidence of each candidate [nat]:".to_owned()];
    lines.extend(diagnosis.decisions.iter().map(|line| format!("  {line}")));
    lines.push("Effects that are no cause:".to_owned());
    lines.extend(diagnosis.not_reported.iter().map(|one| {
        let name = one.scope.as_ref().map_or_else(|| one.effect.clone(), |scope| format!("{}@{scope}", one.effect));
        let gain = one.gain_nats.map_or(String::new(), |gain| format!(" {gain:.1} nat."));
        format!("  {name}:{gain} {}", one.reason)
    }));
    lines.join("\n") + "\n"
}

/// Returns the line on the predicted change of the error.
fn promise(promise: &Promise) -> String {
    let [predicted, low, high, found] = promise.all.changes().map(|change| 100.0 * change);
    format!(
        "    by the laws alone: {found:+.0} %; predicted before it was measured: {predicted:+.0} % (90 % interval {low:+.0} to {high:+.0} %)"
    )
}

/// Returns the line on gains that differ from joint to joint, if they do.
fn joint_gains(diagnosis: &Diagnosis) -> Option<String> {
    let [kp, kd] = diagnosis.joint_gain_ranges()?.map(|[low, high]| format!("{low:.3} to {high:.3}"));
    Some(format!(
        "the gains of the joints differ, kp by factors of {kp} and kd of {kd}: as those of equal motors, so no cause; \
         `extended.toml` has them"
    ))
}

fn error_line(name: &str, diagnosis: &Diagnosis, of: fn(&RmsErrors) -> Option<f64>) -> String {
    let errors = [&diagnosis.baseline, &diagnosis.extended, &diagnosis.noise_floor];
    let [before, after, floor] = errors.map(|errors| of(errors).map_or("-".to_owned(), |value| format!("{value:.4}")));
    format!("{name}, held-out blocks: {before} -> {after} (noise floor {floor})")
}

fn number(value: &ParameterValue) -> String {
    match value {
        ParameterValue::Number(value) => format!("{value:.4}"),
        ParameterValue::Vector(values) => {
            format!("[{}]", values.iter().map(|value| format!("{value:.4}")).collect::<Vec<_>>().join(", "))
        }
    }
}
