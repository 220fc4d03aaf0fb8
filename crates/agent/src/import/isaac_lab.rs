//! `env.yaml` and `agent.yaml` of Isaac Lab, which its training scripts write next to a policy.
//!
//! Joints have the order of the articulation, breadth first, unless an action names them and keeps their order. A term is
//! clipped before it is scaled; histories are term by term, oldest first (`isaaclab/managers/observation_manager.py`).

use fancy_regex::{Regex, RegexBuilder};

use super::deploy_yaml::common_history;
use super::facts::{BY_KIND, Facts, InputFacts, TermFacts, joint_name, term_name};
use super::yaml::Yaml;
use crate::mapping::{HistoryLayout, HistoryOrder, TermName};

/// Groups of observations that an actor may read, best first.
const GROUPS: [&str; 4] = ["policy", "actor", "obs", "student"];

/// Longest expression for names of joints [characters], and the largest memory of a compiled one [bytes].
const MAX_EXPRESSION: usize = 1000;
const MAX_COMPILED: usize = 1 << 20;

/// Reads the files of a training.
pub fn read(source: &str, env: &Yaml, agent: Option<&Yaml>) -> Result<Facts, String> {
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    let action =
        env.get("actions").and_then(|actions| actions.entries().iter().find(|(_, action)| *action != Yaml::Null));
    let robot = env.at(&["scene", "robot"]).or_else(|| env.get("robot")).ok_or("it has no `scene.robot`")?;
    let explicit = action.and_then(|(_, action)| explicit_order(action));
    facts.joints = Some(match explicit {
        Some(names) => facts.found(names, "joint_names of the action, in their order"),
        None => facts.found(BY_KIND.map(str::to_owned).to_vec(), "the order of an articulation in Isaac Lab: by kind"),
    });
    let names = facts.joint_names(&BY_KIND);
    (facts.kp, facts.kd) = gains(robot, &names, &facts)?;
    if let Some(pose) = robot.at(&["init_state", "joint_pos"]) {
        facts.default_pose =
            by_pattern(pose, &names)?.map(|pose| facts.found(pose, "scene.robot.init_state.joint_pos"));
    }
    let dt = env.at(&["sim", "dt"]).and_then(Yaml::number).zip(env.get("decimation").and_then(Yaml::number));
    facts.policy_hz = dt.map(|(dt, decimation)| facts.found(1.0 / (dt * decimation), "sim.dt · decimation"));
    if let Some((name, action)) = action {
        read_action(&mut facts, name, action, &names)?;
    }
    let observations = env.get("observations");
    let group = observations.and_then(|all| GROUPS.into_iter().find_map(|name| Some((name, all.get(name)?))));
    if let Some((name, group)) = group {
        let input = observation(group, &mut facts, &names);
        facts.observation = Some(facts.found(input, &format!("observations.{name}")));
    }
    if let Some(agent) = agent {
        read_agent(&mut facts, agent);
    }
    Ok(facts)
}

/// Returns the joints of an action that lists them by name and keeps the order.
fn explicit_order(action: &Yaml) -> Option<Vec<String>> {
    let names = action.get("joint_names").and_then(Yaml::texts)?;
    let is_plain = names.iter().all(|name| name.chars().all(|letter| letter.is_alphanumeric() || letter == '_'));
    let keeps = action.get("preserve_order") == Some(&Yaml::Bool(true));
    (is_plain && keeps && names.len() > 1).then(|| names.iter().map(|name| joint_name(name)).collect())
}

fn gains(robot: &Yaml, names: &[String], facts: &Facts) -> Result<(Gains, Gains), String> {
    let mut found = [vec![None; names.len()], vec![None; names.len()]];
    for (_, actuator) in robot.get("actuators").map_or(&[][..], Yaml::entries) {
        let expressions =
            actuator.get("joint_names_expr").and_then(Yaml::texts).unwrap_or_else(|| vec![".*".to_owned()]);
        let own: Vec<usize> = matching(&expressions, names)?;
        for (key, gains) in ["stiffness", "damping"].into_iter().zip(&mut found) {
            let Some(value) = actuator.get(key) else { continue };
            let selected: Vec<String> = own.iter().map(|joint| names[*joint].clone()).collect();
            if let Some(values) = by_pattern(value, &selected)? {
                own.iter().zip(values).for_each(|(joint, value)| gains[*joint] = Some(value));
            }
        }
    }
    let [kp, kd] = found.map(|gains| gains.into_iter().collect::<Option<Vec<f64>>>().filter(|gains| !gains.is_empty()));
    let place = |key: &str| format!("scene.robot.actuators.*.{key}");
    Ok((kp.map(|kp| facts.found(kp, &place("stiffness"))), kd.map(|kd| facts.found(kd, &place("damping")))))
}

type Gains = Option<super::facts::Found<Vec<f64>>>;

/// Returns the indices of names that one of the expressions matches as a whole.
///
/// Expressions are for the names in robot files, which end with `_joint`; those of some robots do not.
fn matching(expressions: &[String], names: &[String]) -> Result<Vec<usize>, String> {
    let mut found = Vec::new();
    for expression in expressions {
        let compiled = compiled(expression)?;
        // A search that takes too long finds nothing.
        let with_ending = |ending: &str| {
            let matches = |joint: &usize| compiled.is_match(&format!("{}{ending}", names[*joint])).unwrap_or(false);
            (0..names.len()).filter(matches).collect::<Vec<_>>()
        };
        let long = with_ending("_joint");
        found.extend(if long.is_empty() { with_ending("") } else { long });
    }
    found.sort_unstable();
    found.dedup();
    Ok(found)
}

fn compiled(expression: &str) -> Result<Regex, String> {
    if expression.len() > MAX_EXPRESSION {
        let len = expression.len();
        return Err(format!(
            "an expression for names of joints has {len} characters; at most {MAX_EXPRESSION} are read"
        ));
    }
    // Expressions of Python may look ahead: `^(?!.*_hip_joint).*` is every joint but the hips.
    let whole = RegexBuilder::new(&format!("^(?:{expression})$")).delegate_size_limit(MAX_COMPILED).build();
    whole.map_err(|_| format!("`{expression}` is not an expression for names of joints"))
}

/// Returns a value for each name: one number for all, or a map from expressions to numbers. `None`: a name has none.
fn by_pattern(value: &Yaml, names: &[String]) -> Result<Option<Vec<f64>>, String> {
    if let Some(number) = value.number() {
        return Ok(Some(vec![number; names.len()]));
    }
    let mut values = vec![None; names.len()];
    for (expression, value) in value.entries() {
        let Some(value) = value.number() else { continue };
        for joint in matching(std::slice::from_ref(expression), names)? {
            values[joint] = Some(value);
        }
    }
    Ok(values.into_iter().collect())
}

fn read_action(facts: &mut Facts, name: &str, action: &Yaml, names: &[String]) -> Result<(), String> {
    if let Some(scale) = action.get("scale") {
        let values = match scale.number() {
            Some(number) => Some(vec![number]),
            None => by_pattern(scale, names)?,
        };
        facts.action_scale = values.map(|values| facts.found(values, &format!("actions.{name}.scale")));
    }
    let class = action.get("class_type").and_then(Yaml::text).unwrap_or_default();
    if !class.is_empty() && !class.contains("JointPosition") {
        facts.notes.push(format!("the action `{name}` is a {class}; Twinstep commands joint positions"));
    }
    if action.get("use_default_offset") == Some(&Yaml::Bool(false)) {
        let offset = action.get("offset").map_or_else(|| "0".to_owned(), |offset| format!("{offset:?}"));
        facts.notes.push(format!(
            "actions are not relative to the default pose (`offset` = {offset}): a mapping has one pose"
        ));
    }
    Ok(())
}

fn observation(group: &Yaml, facts: &mut Facts, names: &[String]) -> InputFacts {
    let mut input = InputFacts::default();
    let of_group = group.get("history_length").and_then(Yaml::number);
    for (name, term) in group.entries().iter().filter(|(_, term)| term.get("func").is_some()) {
        let function = term.get("func").and_then(Yaml::text).unwrap_or_default();
        let function = function.rsplit([':', '.']).next().unwrap_or_default();
        let quantity = if function == "joint_pos" {
            Some(TermName::AbsoluteJointPosition)
        } else {
            term_name(function).or_else(|| term_name(name))
        };
        let Some(quantity) = quantity else {
            input.unknown.push(name.clone());
            continue;
        };
        let mut found = TermFacts::new(quantity, name);
        found.scale = term.get("scale").and_then(Yaml::one_or_more).unwrap_or_default();
        found.clip = term.get("clip").and_then(Yaml::numbers).and_then(|clip| clip.try_into().ok());
        found.period = term.at(&["params", "period"]).and_then(Yaml::number);
        let steps = of_group.or_else(|| term.get("history_length").and_then(Yaml::number)).unwrap_or(0.0);
        found.history = Some(steps.max(1.0) as usize);
        let order = term.at(&["params", "asset_cfg", "joint_names"]).and_then(Yaml::texts).unwrap_or_default();
        let order: Vec<String> = order.iter().map(|name| joint_name(name)).collect();
        let is_kept = term.at(&["params", "asset_cfg", "preserve_order"]) == Some(&Yaml::Bool(true));
        if is_kept && order.len() == names.len() && order != names {
            facts
                .notes
                .push(format!("`{name}` has the joints in another order than the action: a mapping has one order"));
        }
        input.terms.push(found);
    }
    common_history(&mut input, HistoryLayout::Terms, HistoryOrder::OldestFirst);
    input
}

fn read_agent(facts: &mut Facts, agent: &Yaml) {
    let flag = |path: &[&str]| agent.at(path) == Some(&Yaml::Bool(true));
    if flag(&["empirical_normalization"])
        || flag(&["policy", "actor_obs_normalization"])
        || flag(&["actor", "obs_normalization"])
    {
        facts.notes.push(
            "agent.yaml: observations are normalised; the exported network must contain the normaliser".to_owned(),
        );
    }
    if let Some(bound) = agent.get("clip_actions").and_then(Yaml::number) {
        facts.action_clip =
            Some(super::facts::Found { value: [-bound, bound], place: "agent.yaml, clip_actions".to_owned() });
    }
}

#[cfg(test)]
mod tests {
    use super::compiled;

    #[test]
    fn expressions_that_would_fill_the_memory_are_refused() {
        assert!(compiled("^(?!.*_hip_joint).*").expect("an expression").is_match("FL_calf_joint").expect("a match"));
        assert!(compiled(&"a".repeat(1001)).expect_err("long").contains("1001 characters"));
        assert!(compiled("(.{1000}){1000}").is_err(), "large when it is compiled");
    }
}
