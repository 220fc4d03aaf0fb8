//! `deploy.yaml` of unitree_rl_lab and unitree_rl_mjlab.
//!
//! `stiffness` and `damping` are in the order of the motors, everything else in that of the policy; `joint_ids_map` gives the
//! motor of each joint of the policy. Histories are term by term, oldest first, unless `use_gym_history` is set; values are
//! clipped before the scale, unless `scale_first` is set (`deploy/include/isaaclab/manager/observation_manager.h`).

use super::facts::{BY_MOTOR, Facts, InputFacts, TermFacts, history, term_name};
use super::yaml::Yaml;
use crate::mapping::{HistoryLayout, HistoryOrder, TermName};

/// Reads the file.
pub fn read(source: &str, yaml: &Yaml) -> Result<Facts, String> {
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    let ids = yaml.get("joint_ids_map").and_then(Yaml::numbers).ok_or("`joint_ids_map` is missing")?;
    let motor = |id: &f64| if *id >= 0.0 && id.fract() == 0.0 { Some(*id as usize) } else { None };
    let motors: Option<Vec<usize>> = ids.iter().map(motor).collect();
    let motors = motors.ok_or_else(|| format!("`joint_ids_map` = {ids:?}; indices of motors are expected"))?;
    let names: Option<Vec<String>> =
        motors.iter().map(|motor| BY_MOTOR.get(*motor).map(|&name| name.to_owned())).collect();
    match names {
        Some(names) if names.len() == BY_MOTOR.len() => {
            facts.joints = Some(facts.found(names, "joint_ids_map, the motors of the Go2"));
        }
        _ => {
            return Err(format!(
                "`joint_ids_map` has {} joints; it is not a robot with the twelve motors of the Go2",
                ids.len()
            ));
        }
    }
    facts.kp =
        by_motor(yaml, "stiffness", &motors)?.map(|value| facts.found(value, "stiffness, in the order of the motors"));
    facts.kd =
        by_motor(yaml, "damping", &motors)?.map(|value| facts.found(value, "damping, in the order of the motors"));
    facts.policy_hz = yaml.get("step_dt").and_then(Yaml::number).map(|dt| facts.found(1.0 / dt, "step_dt"));
    let pose = yaml.get("default_joint_pos").and_then(Yaml::numbers);
    facts.default_pose = pose.clone().map(|pose| facts.found(pose, "default_joint_pos"));
    if let Some((name, action)) = yaml.get("actions").and_then(|actions| actions.entries().first()) {
        let place = format!("actions.{name}.scale");
        facts.action_scale = action.get("scale").and_then(Yaml::one_or_more).map(|scale| facts.found(scale, &place));
        let offset = action.get("offset").and_then(Yaml::numbers);
        if let (Some(offset), Some(pose)) = (offset, pose)
            && offset != pose
        {
            facts.notes.push(
                "actions are relative to another pose (`offset`) than observed positions (`default_joint_pos`): a mapping has one pose"
                    .to_owned(),
            );
        }
        if !name.contains("JointPosition") {
            facts.notes.push(format!("the action `{name}` is not a joint position; Twinstep commands positions"));
        }
        if action.get("joint_ids").is_some_and(|ids| !ids.items().is_empty() && ids.items().len() < motors.len()) {
            facts.notes.push("the action has some of the joints only (`joint_ids`)".to_owned());
        }
    }
    observations(yaml, &mut facts);
    Ok(facts)
}

fn by_motor(yaml: &Yaml, key: &str, motors: &[usize]) -> Result<Option<Vec<f64>>, String> {
    let Some(gains) = yaml.get(key).and_then(Yaml::numbers) else { return Ok(None) };
    let each: Option<Vec<f64>> = motors.iter().map(|motor| gains.get(*motor).copied()).collect();
    each.map(Some)
        .ok_or_else(|| format!("`{key}` has {} numbers, fewer than the motors of `joint_ids_map`", gains.len()))
}

/// A group of observations has terms; some files have several, each an input of the network.
fn observations(yaml: &Yaml, facts: &mut Facts) {
    let Some(all) = yaml.get("observations") else { return };
    let is_group = |value: &Yaml| {
        value.entries().iter().any(|(_, term)| term.get("scale").is_some() || term.get("params").is_some())
    };
    let groups: Vec<&(String, Yaml)> = all.entries().iter().filter(|(_, value)| is_group(value)).collect();
    if groups.is_empty() {
        let input = input(all, facts);
        facts.observation = Some(facts.found(input, "observations"));
        return;
    }
    for (index, (name, group)) in groups.into_iter().enumerate() {
        let input = input(group, facts);
        if index == 0 {
            facts.observation = Some(facts.found(input, &format!("observations.{name}")));
        } else {
            facts.inputs.insert(name.clone(), input);
        }
    }
}

fn input(group: &Yaml, facts: &mut Facts) -> InputFacts {
    let is = |key: &str| group.get(key) == Some(&Yaml::Bool(true));
    let mut input = InputFacts::default();
    for (name, term) in group.entries().iter().filter(|(_, term)| !term.entries().is_empty()) {
        let quantity = if name == "joint_pos" { Some(TermName::AbsoluteJointPosition) } else { term_name(name) };
        let Some(quantity) = quantity else {
            input.unknown.push(name.clone());
            continue;
        };
        let mut found = TermFacts::new(quantity, name);
        found.scale = term.get("scale").and_then(Yaml::one_or_more).unwrap_or_default();
        found.clip = term.get("clip").and_then(Yaml::numbers).and_then(|clip| clip.try_into().ok());
        if let (true, Some(clip)) = (is("scale_first"), &mut found.clip) {
            match found.scale[..] {
                [] => {}
                [first, ref rest @ ..] if rest.iter().all(|scale| *scale == first) && first > 0.0 => {
                    *clip = clip.map(|bound| bound / first);
                }
                _ => facts
                    .notes
                    .push(format!("`{name}` is clipped after several scales (`scale_first`): its clip is left out")),
            }
        }
        let steps = term.get("history_length").and_then(Yaml::number).unwrap_or(1.0).max(1.0);
        found.history = Some(steps as usize);
        found.period = term.at(&["params", "period"]).and_then(Yaml::number);
        input.terms.push(found);
    }
    let layout = if is("use_gym_history") { HistoryLayout::Frames } else { HistoryLayout::Terms };
    common_history(&mut input, layout, HistoryOrder::OldestFirst);
    input
}

/// Moves the length of the history from the terms to the input if it is that of all.
pub fn common_history(input: &mut InputFacts, layout: HistoryLayout, order: HistoryOrder) {
    let lengths: Vec<usize> = input.terms.iter().map(|term| term.history.unwrap_or(1)).collect();
    let longest = lengths.iter().copied().max().unwrap_or(1);
    input.history = history(longest, layout, order);
    for (term, length) in input.terms.iter_mut().zip(lengths) {
        term.history = (length != longest).then_some(length);
    }
}
