//! Metadata that mjlab, Isaac Lab's whole-body tracking and their descendants write into ONNX files: lists as text with commas.

use super::facts::{Facts, InputFacts, TermFacts, history, joint_name, term_name};
use crate::mapping::{HistoryLayout, HistoryOrder, TermName};
use crate::onnx::OnnxNetwork;

/// Reads the metadata of a network. Returns `None` if it has none of these entries.
pub fn read(source: &str, network: &OnnxNetwork) -> Result<Option<Facts>, String> {
    let mut facts = Facts { source: format!("metadata of {source}"), ..Facts::default() };
    let texts = |key: &str| {
        let text = network.metadata(key)?;
        let text = text.trim().trim_start_matches('[').trim_end_matches(']');
        let items = text.split(',').map(|item| item.trim().trim_matches(['\'', '"']).to_owned());
        Some(items.filter(|item| !item.is_empty()).collect::<Vec<String>>())
    };
    let numbers = |key: &str| {
        let Some(texts) = texts(key) else { return Ok(None) };
        let numbers: Result<Vec<f64>, _> = texts.iter().map(|text| text.parse::<f64>()).collect();
        numbers.map(Some).map_err(|_| format!("metadata `{key}` = {texts:?}; numbers with commas are expected"))
    };
    let names = texts("joint_names").or_else(|| texts("action_joint_names"));
    facts.joints = names.map(|names| facts.found(names.iter().map(|name| joint_name(name)).collect(), "joint_names"));
    facts.kp = numbers("joint_stiffness")?.map(|gains| facts.found(gains, "joint_stiffness"));
    facts.kd = numbers("joint_damping")?.map(|gains| facts.found(gains, "joint_damping"));
    facts.action_scale = numbers("action_scale")?.map(|scale| facts.found(scale, "action_scale"));
    facts.default_pose = numbers("default_joint_pos")?.map(|pose| facts.found(pose, "default_joint_pos"));
    let dt = numbers("policy_dt")?.or(numbers("step_dt")?).and_then(|dt| dt.first().copied());
    facts.policy_hz = dt.map(|dt| facts.found(1.0 / dt, "policy_dt"));
    if let Some(names) = texts("observation_names") {
        let mut input = InputFacts::default();
        for name in names {
            // The tasks of mjlab call the relative position `joint_pos`.
            let term = if name == "joint_pos" { Some(TermName::JointPosition) } else { term_name(&name) };
            match term {
                Some(term) => input.terms.push(TermFacts::new(term, &name)),
                None => input.unknown.push(name),
            }
        }
        let length = numbers("history_length")?.and_then(|length| length.first().copied()).unwrap_or(1.0);
        input.history = history(length as usize, HistoryLayout::Terms, HistoryOrder::OldestFirst);
        facts.observation = Some(facts.found(input, "observation_names"));
        facts.notes.push("the metadata has no scales of the observation: 1 is taken".to_owned());
    }
    let is_empty = facts.joints.is_none() && facts.kp.is_none() && facts.observation.is_none();
    Ok((!is_empty).then_some(facts))
}
