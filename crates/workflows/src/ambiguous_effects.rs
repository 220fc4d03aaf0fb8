//! Effects that the next experiment with a walking robot is about, from the findings of `twinstep diagnose`.

use std::path::Path;

use twinstep_diagnose::Diagnosis;
use twinstep_identify::EffectAtScope;

use crate::failure::Failure;

/// Returns the causes that a diagnosis could not tell from others, with the others; all causes if there are none.
///
/// `folder` is the output folder of `twinstep diagnose`.
pub fn read(folder: &Path) -> Result<Vec<EffectAtScope>, Failure> {
    let path = folder.join("findings.json");
    let wrong =
        |cause: String| Failure::Input(miette::miette!("`--findings`: cannot read {}: {cause}", path.display()));
    let text = std::fs::read_to_string(&path).map_err(|error| wrong(error.to_string()))?;
    let diagnosis: Diagnosis = serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    let effects: Result<Vec<EffectAtScope>, _> = names(&diagnosis).iter().map(|name| name.parse()).collect();
    let effects = effects.map_err(|error| wrong(format!("{error}")))?;
    if effects.is_empty() {
        return Err(Failure::Input(miette::miette!(
            "`--findings` = {}: the diagnosis has no cause\n  name effects with --unknowns",
            folder.display()
        )));
    }
    Ok(effects)
}

/// Returns the names of the effects with their scopes, each once.
pub fn names(diagnosis: &Diagnosis) -> Vec<String> {
    let mut ambiguous = Vec::new();
    let mut all = Vec::new();
    let add = |list: &mut Vec<String>, name: String| {
        if !list.contains(&name) {
            list.push(name);
        }
    };
    for cause in &diagnosis.findings {
        let name = format!("{}@{}", cause.effect, cause.scope);
        add(&mut all, name.clone());
        let is_correlated = diagnosis.confusable.iter().any(|pair| pair.effects.contains(&cause.effect));
        if is_correlated || !cause.ambiguous_with.is_empty() {
            add(&mut ambiguous, name);
        }
        cause.ambiguous_with.iter().for_each(|other| add(&mut ambiguous, other.clone()));
    }
    if ambiguous.is_empty() { all } else { ambiguous }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns findings with a cause for each effect with its scope and what it is ambiguous with.
    fn findings(causes: &[(&str, &str, &[&str])], correlated: &str) -> Diagnosis {
        let causes: Vec<_> = causes
            .iter()
            .map(|(effect, scope, others)| {
                serde_json::json!({
                    "effect": effect, "scope": scope, "parameters": {}, "held_out_gain": 0.5, "score_nats": 50.0,
                    "threshold_nats": 10.0, "ambiguous_with": others, "posterior": [], "rivals": [], "evidence": "",
                })
            })
            .collect();
        let errors = serde_json::json!({"torque_rmse_nm": null, "q_rmse_rad": 0.01});
        serde_json::from_value(serde_json::json!({
            "baseline": errors, "extended": errors, "noise_floor": errors, "findings": causes, "confusable": [
                {"effects": [correlated, "viscous_friction"], "correlation": 0.95, "experiment": ""}
            ],
            "unexplained": {"fraction": 0.1, "depends_on": [], "text": ""}, "next_experiment": null,
            "extended_model": "extended.toml",
        }))
        .expect("findings")
    }

    #[test]
    fn ambiguous_effects_are_named_once_and_clear_ones_only_if_there_are_no_others() {
        let causes: [(&str, &str, &[&str]); 3] = [
            ("payload", "base", &["com_shift@base"]),
            ("armature", "calf", &[]),
            ("coulomb_friction", "calf", &["com_shift@base"]),
        ];
        assert_eq!(names(&findings(&causes, "none")), ["payload@base", "com_shift@base", "coulomb_friction@calf"]);
        assert_eq!(names(&findings(&causes[1..2], "none")), ["armature@calf"]);
        assert_eq!(names(&findings(&causes[..2], "armature")), ["payload@base", "com_shift@base", "armature@calf"]);
    }
}
