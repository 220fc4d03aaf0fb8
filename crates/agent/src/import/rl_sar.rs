//! `config.yaml` of rl_sar, with the `base.yaml` of its robot in the folder above.
//!
//! Values per joint are in the order of the policy. Older files name the joints in `joint_names` of `config.yaml`; newer ones
//! give in `joint_mapping` the index of each joint of the policy among the `joint_names` of `base.yaml`. In
//! `observations_history` 0 is the present step.

use super::facts::{Facts, InputFacts, TermFacts, history, joint_name, term_name};
use super::yaml::Yaml;
use crate::mapping::{HistoryLayout, HistoryOrder, TermName};

/// Reads the file of a policy and that of its robot.
pub fn read(source: &str, config: &Yaml, base: Option<&Yaml>) -> Result<Facts, String> {
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    let config = body(config, "observations").ok_or("it has no `observations`")?;
    let base = base.and_then(|base| body(base, "joint_names"));
    let either = |key: &str| config.get(key).or_else(|| base.and_then(|base| base.get(key)));
    facts.joints = joints(config, base)?.map(|(names, place)| facts.found(names, place));
    let list = |key: &str| config.get(key).and_then(Yaml::numbers);
    facts.kp = list("rl_kp").map(|gains| facts.found(gains, "rl_kp"));
    facts.kd = list("rl_kd").map(|gains| facts.found(gains, "rl_kd"));
    facts.action_scale =
        config.get("action_scale").and_then(Yaml::one_or_more).map(|scale| facts.found(scale, "action_scale"));
    facts.default_pose =
        either("default_dof_pos").and_then(Yaml::numbers).map(|pose| facts.found(pose, "default_dof_pos"));
    let rate = |key: &str| either(key).and_then(Yaml::number);
    facts.policy_hz =
        rate("dt").zip(rate("decimation")).map(|(dt, count)| facts.found(1.0 / (dt * count), "dt · decimation"));
    facts.action_clip = clip(config).map(|clip| facts.found(clip, "clip_actions_lower, clip_actions_upper"));
    facts.observation = Some(facts.found(observation(config)?, "observations"));
    if let Some(wheels) = either("wheel_indices").filter(|wheels| !wheels.items().is_empty()) {
        facts.notes.push(format!("the robot has {} wheels, which no endpoint has", wheels.items().len()));
    }
    Ok(facts)
}

/// The settings are below the name of robot and policy.
fn body<'a>(yaml: &'a Yaml, key: &str) -> Option<&'a Yaml> {
    if yaml.get(key).is_some() {
        return Some(yaml);
    }
    yaml.entries().iter().map(|(_, value)| value).find(|value| value.get(key).is_some())
}

fn joints(config: &Yaml, base: Option<&Yaml>) -> Result<Option<(Vec<String>, &'static str)>, String> {
    let names = |yaml: &Yaml| yaml.get("joint_names").and_then(Yaml::texts);
    let plain = |names: Vec<String>| names.iter().map(|name| joint_name(name)).collect::<Vec<_>>();
    if let Some(names) = names(config) {
        return Ok(Some((plain(names), "joint_names")));
    }
    let Some(all) = base.and_then(names) else { return Ok(None) };
    let order = config.get("joint_mapping").and_then(Yaml::numbers);
    let Some(order) = order else { return Ok(Some((plain(all), "joint_names of base.yaml"))) };
    let named: Option<Vec<String>> = order.iter().map(|index| all.get(*index as usize).cloned()).collect();
    let named =
        named.ok_or_else(|| format!("`joint_mapping` = {order:?} is not an order of the {} joints", all.len()))?;
    Ok(Some((plain(named), "joint_mapping, into joint_names of base.yaml")))
}

fn clip(config: &Yaml) -> Option<[f64; 2]> {
    let bound = |key: &str| match config.get(key)? {
        Yaml::Number(bound) => Some(*bound),
        list => {
            let numbers = list.numbers()?;
            let first = *numbers.first()?;
            numbers.iter().all(|number| *number == first).then_some(first)
        }
    };
    Some([bound("clip_actions_lower")?, bound("clip_actions_upper")?])
}

fn observation(config: &Yaml) -> Result<InputFacts, String> {
    let names = config.get("observations").and_then(Yaml::texts).ok_or("`observations` is not a list of names")?;
    let mut input = InputFacts::default();
    for name in names {
        let Some(term) = term_name(&name) else {
            input.unknown.push(name);
            continue;
        };
        let key = match term {
            TermName::BaseLinearVelocity => Some("lin_vel_scale"),
            TermName::BaseAngularVelocity => Some("ang_vel_scale"),
            TermName::VelocityCommand => Some("commands_scale"),
            TermName::JointPosition => Some("dof_pos_scale"),
            TermName::JointVelocity => Some("dof_vel_scale"),
            _ => None,
        };
        let mut found = TermFacts::new(term, &name);
        found.scale = key.and_then(|key| config.get(key)).and_then(Yaml::one_or_more).unwrap_or_default();
        found.period = config.get("cycle_time").and_then(Yaml::number).filter(|_| term == TermName::GaitPhase);
        input.terms.push(found);
    }
    let steps = config.get("observations_history").and_then(Yaml::numbers).unwrap_or_default();
    let is_range = |first: f64, step: f64| steps.iter().enumerate().all(|(i, value)| *value == first + step * i as f64);
    let last = steps.len().max(1) as f64 - 1.0;
    let order = match (is_range(0.0, 1.0), is_range(last, -1.0)) {
        (true, _) => HistoryOrder::NewestFirst,
        (false, true) => HistoryOrder::OldestFirst,
        _ => return Err(format!("`observations_history` = {steps:?} leaves steps out, which a mapping cannot")),
    };
    let layout = match config.get("observations_history_priority").and_then(Yaml::text) {
        Some("term") => HistoryLayout::Terms,
        _ => HistoryLayout::Frames,
    };
    input.history = history(steps.len(), layout, order);
    Ok(input)
}
