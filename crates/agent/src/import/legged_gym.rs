//! Configs of legged_gym and its descendants: Python classes with constants.
//!
//! Only assignments of constants are read. What a file does not set has the value of `LeggedRobotCfg`, as published. A
//! config does not contain the terms of the observation: [`ObservationOrder`] has those of each program, by their number. Joints
//! have the order of Isaac Gym, leg by leg.

use std::collections::BTreeMap;

use super::facts::{BY_LEG, Facts, InputFacts, TermFacts, history};
use super::yaml::Yaml;
use crate::mapping::{HistoryLayout, HistoryOrder, TermName};

/// Constants by path, such as `control.action_scale`.
pub type Constants = BTreeMap<String, Yaml>;

/// Values of `LeggedRobotCfg` (github.com/leggedrobotics/legged_gym, BSD-3-Clause).
const DEFAULTS: [(&str, f64); 7] = [
    ("sim.dt", 0.005),
    ("control.decimation", 4.0),
    ("control.action_scale", 0.5),
    ("normalization.clip_actions", 100.0),
    ("normalization.obs_scales.lin_vel", 2.0),
    ("normalization.obs_scales.ang_vel", 0.25),
    ("normalization.obs_scales.dof_vel", 0.05),
];

/// Reads the text of a config. `inputs` is the length of the network's input, if it is known.
pub fn read(source: &str, text: &str, inputs: Option<usize>) -> Result<Facts, String> {
    let constants = constants(text);
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    let pose = constants.get("init_state.default_joint_angles").ok_or("it has no `default_joint_angles`")?;
    let number = |key: &str| {
        let own = constants.get(key).and_then(Yaml::number);
        own.or_else(|| DEFAULTS.iter().find(|(name, _)| *name == key).map(|(_, value)| *value))
    };
    facts.joints = Some(facts.found(BY_LEG.map(str::to_owned).to_vec(), "the order of Isaac Gym: leg by leg"));
    let of_joint = |value: &Yaml, joint: &str| {
        let entry =
            |(key, value): &(String, Yaml)| format!("{joint}_joint").contains(key).then(|| value.number()).flatten();
        // The longest key is the most specific.
        let mut entries: Vec<_> = value.entries().iter().collect();
        entries.sort_by_key(|(key, _)| std::cmp::Reverse(key.len()));
        entries.into_iter().find_map(entry)
    };
    let by_joint = |value: &Yaml| BY_LEG.iter().map(|joint| of_joint(value, joint)).collect::<Option<Vec<f64>>>();
    facts.default_pose = by_joint(pose).map(|pose| facts.found(pose, "init_state.default_joint_angles"));
    let gains = |key: &str| constants.get(key).and_then(by_joint);
    facts.kp = gains("control.stiffness").map(|gains| facts.found(gains, "control.stiffness"));
    facts.kd = gains("control.damping").map(|gains| facts.found(gains, "control.damping"));
    let reduction = ["control.hip_reduction", "control.hip_scale_reduction"].into_iter().find_map(number);
    facts.action_scale =
        number("control.action_scale").map(|scale| match reduction.filter(|reduction| *reduction != 1.0) {
            Some(reduction) => {
                let each = BY_LEG.map(|joint| if joint.ends_with("hip") { scale * reduction } else { scale }).to_vec();
                facts.found(each, "control.action_scale, hips times hip_reduction")
            }
            None => facts.found(vec![scale], "control.action_scale"),
        });
    let rate = number("sim.dt").zip(number("control.decimation"));
    facts.policy_hz = rate.map(|(dt, count)| facts.found(1.0 / (dt * count), "sim.dt · control.decimation"));
    facts.action_clip =
        number("normalization.clip_actions").map(|clip| facts.found([-clip, clip], "normalization.clip_actions"));
    let step = number("env.num_one_step_observations")
        .or_else(|| number("env.n_proprio"))
        .or_else(|| number("env.num_observations"));
    observation(&mut facts, &number, step.map(|step| step as usize), inputs);
    Ok(facts)
}

fn observation(facts: &mut Facts, number: &dyn Fn(&str) -> Option<f64>, step: Option<usize>, inputs: Option<usize>) {
    let scale = |key: &str| number(&format!("normalization.obs_scales.{key}"));
    let [linear, angular] = [scale("lin_vel"), scale("ang_vel")].map(|scale| scale.unwrap_or(1.0));
    let Some(order) = ObservationOrder::of([step, inputs]) else {
        facts.notes.push(format!(
            "the config does not say what the {} numbers of the observation are; add [[observation]] from `compute_observations`",
            step.map_or_else(|| "?".to_owned(), |step| step.to_string())
        ));
        return;
    };
    let steps = inputs.or(step).unwrap_or(order.len()) / order.len();
    let input = InputFacts {
        terms: order.terms(&scale, vec![linear, linear, angular]),
        unknown: Vec::new(),
        history: history(steps, HistoryLayout::Frames, HistoryOrder::NewestFirst),
    };
    let frames = if steps == 1 { String::new() } else { format!(", {steps} steps, the present one first") };
    facts.notes.push(format!(
        "the config does not contain the order of the observation: {}{frames} is taken; compare it with `compute_observations`",
        order.description()
    ));
    facts.observation = Some(facts.found(input, "number of observations"));
    facts.is_order_assumed = true;
}

/// Order of the terms in an observation, which no config of this family contains: each program has one, and a length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ObservationOrder {
    /// `legged_gym`: velocities of the base, gravity, command, joints, action; 48 numbers.
    WithVelocity,
    /// The same without the linear velocity, which a robot does not measure; 45 numbers.
    WithoutVelocity,
    /// `unitree_rl_gym`: as before, and a clock of the gait at the end; 47 numbers.
    WithClock,
    /// `HIMLoco`: the command first, and a history; 45 numbers a step.
    CommandFirst,
}

impl ObservationOrder {
    /// Returns the order by the lengths of one step and of the network's input, as far as they are known.
    pub fn of(lengths: [Option<usize>; 2]) -> Option<Self> {
        let has = |len: usize| lengths.contains(&Some(len));
        let has_steps_of = |one: usize| lengths.iter().flatten().any(|len| *len > one && len.is_multiple_of(one));
        let fits = [
            (has_steps_of(45), Self::CommandFirst),
            (has(45), Self::WithoutVelocity),
            (has(47), Self::WithClock),
            (has(48) || has_steps_of(48), Self::WithVelocity),
        ];
        fits.into_iter().find_map(|(fits, order)| fits.then_some(order))
    }

    /// Returns the length of one step.
    pub fn len(self) -> usize {
        match self {
            Self::WithVelocity => 48,
            Self::WithoutVelocity | Self::CommandFirst => 45,
            Self::WithClock => 47,
        }
    }

    /// Says whose order it is.
    pub fn description(self) -> &'static str {
        match self {
            Self::WithVelocity => "that of legged_gym",
            Self::WithoutVelocity => "that of legged_gym without the linear velocity",
            Self::WithClock => "that of unitree_rl_gym, with a gait clock of 0.8 s,",
            Self::CommandFirst => "that of HIMLoco, with the command first",
        }
    }

    /// Returns the terms. `scale` gives factors by their names in `obs_scales`.
    pub fn terms(self, scale: &dyn Fn(&str) -> Option<f64>, command: Vec<f64>) -> Vec<TermFacts> {
        let term = |term: TermName, scale: Vec<f64>| TermFacts { scale, ..TermFacts::new(term, term.name()) };
        let scaled = |name: TermName, key: &str| term(name, scale(key).into_iter().collect());
        let velocity = scaled(TermName::BaseLinearVelocity, "lin_vel");
        let gyro = scaled(TermName::BaseAngularVelocity, "ang_vel");
        let gravity = term(TermName::ProjectedGravity, Vec::new());
        let command = term(TermName::VelocityCommand, command);
        let mut terms = match self {
            Self::WithVelocity => vec![velocity, gyro, gravity, command],
            Self::CommandFirst => vec![command, gyro, gravity],
            Self::WithoutVelocity | Self::WithClock => vec![gyro, gravity, command],
        };
        terms.extend([
            scaled(TermName::JointPosition, "dof_pos"),
            scaled(TermName::JointVelocity, "dof_vel"),
            term(TermName::PreviousAction, Vec::new()),
        ]);
        if self == Self::WithClock {
            terms.push(TermFacts { period: Some(0.8), ..term(TermName::GaitPhase, Vec::new()) });
        }
        terms
    }
}

/// Returns the constants that a Python file assigns in its classes, by path without the outermost class.
///
/// Classes of training algorithms (`...PPO`) are left out. A value that is not a constant may be the name of one before it.
pub fn constants(text: &str) -> Constants {
    let mut scopes: Vec<(usize, String)> = Vec::new();
    let mut constants = Constants::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let line = without_comment(line);
        let content = line.trim();
        let indent = line.len() - line.trim_start().len();
        if content.is_empty() {
            continue;
        }
        while scopes.last().is_some_and(|(own, _)| *own >= indent) {
            scopes.pop();
        }
        if let Some(name) = content.strip_prefix("class ") {
            let name = name.split(['(', ':']).next().unwrap_or_default().trim().to_owned();
            scopes.push((indent, name));
            continue;
        }
        let Some((name, value)) = content.split_once('=').filter(|(name, _)| is_name(name.trim())) else { continue };
        let mut value = value.trim().to_owned();
        while open_brackets(&value) > 0 && value.len() < 1 << 16 {
            let Some(next) = lines.next() else { break };
            value.push_str(without_comment(next).trim());
        }
        let is_training = scopes.first().is_some_and(|(_, name)| name.ends_with("PPO"));
        if is_training {
            continue;
        }
        let path = scopes.iter().skip(1).map(|(_, name)| name.as_str()).chain([name.trim()]);
        let path = path.collect::<Vec<_>>().join(".");
        if let Some(value) = constant(&value).or_else(|| constants.get(&value).cloned()) {
            constants.insert(path, value);
        }
    }
    constants
}

fn is_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|letter| letter.is_alphanumeric() || letter == '_')
}

fn without_comment(line: &str) -> &str {
    let mut quote = None;
    for (index, letter) in line.char_indices() {
        match (quote, letter) {
            (None, '#') => return &line[..index],
            (None, '\'' | '"') => quote = Some(letter),
            (Some(open), letter) if open == letter => quote = None,
            _ => {}
        }
    }
    line
}

fn open_brackets(text: &str) -> i32 {
    let count = |letters: [char; 3]| text.chars().filter(|letter| letters.contains(letter)).count() as i32;
    count(['(', '[', '{']) - count([')', ']', '}'])
}

/// Returns a number, text, list or dictionary of Python. Those are YAML too, but for products and a trailing comma.
fn constant(text: &str) -> Option<Yaml> {
    if let Some((one, other)) = text.split_once('*')
        && let (Ok(one), Ok(other)) = (one.trim().parse::<f64>(), other.trim().parse::<f64>())
    {
        return Some(Yaml::Number(one * other));
    }
    let text = text.replace('(', "[").replace(')', "]").replace("':", "': ").replace("\":", "\": ");
    match Yaml::parse(&text).ok()? {
        Yaml::Text(word) if !text.trim_start().starts_with(['\'', '"']) && is_name(&word) => None,
        // `1.` is a number of Python.
        value => Some(value),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "from base import LeggedRobotCfg\nSCALE = 0.25\n\nclass Go2Cfg( LeggedRobotCfg ):\n    class init_state( LeggedRobotCfg.init_state ):\n        pos = [0.0, 0.0, 0.42] # x,y,z [m]\n        default_joint_angles = { # = target angles\n            'FL_hip_joint': 0.1,   # [rad]\n            'RL_hip_joint': 0.1,\n            'FR_hip_joint': -0.1 ,\n            'RR_hip_joint': -0.1,\n            'FL_thigh_joint': 0.8,\n            'RL_thigh_joint': 1.,\n            'FR_thigh_joint': 0.8,\n            'RR_thigh_joint': 1.,\n            'FL_calf_joint': -1.5,\n            'RL_calf_joint': -1.5,\n            'FR_calf_joint': -1.5,\n            'RR_calf_joint': -1.5,\n        }\n    class env(LeggedRobotCfg.env):\n        num_one_step_observations = 45\n        num_observations = num_one_step_observations * 6\n    class control( LeggedRobotCfg.control ):\n        stiffness = {'hip_joint': 20., 'joint': 40.}  # [N*m/rad]\n        damping = {'joint': 1.0}\n        action_scale = SCALE\n        decimation = 4\n        hip_reduction = 0.5\n\nclass Go2CfgPPO( LeggedRobotCfgPPO ):\n    class control:\n        decimation = 9\n";

    #[test]
    fn classes_of_legged_gym_are_read_joint_by_joint() {
        let facts = read("go2_config.py", TEXT, Some(270)).expect("a config");
        assert_eq!(facts.kp.expect("kp").value[..3], [20.0, 40.0, 40.0]);
        assert_eq!(facts.default_pose.expect("pose").value[6..], [0.1, 1.0, -1.5, -0.1, 1.0, -1.5]);
        assert_eq!(facts.action_scale.expect("scale").value[..3], [0.125, 0.25, 0.25]);
        assert_eq!(facts.policy_hz.expect("rate").value, 50.0);
        let input = facts.observation.expect("terms").value;
        assert_eq!((input.terms.len(), input.history.map(|history| history.length)), (6, Some(6)));
        assert_eq!(input.terms[0].scale, [2.0, 2.0, 0.25]);
    }
}
