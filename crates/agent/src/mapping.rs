//! The mapping file: how the observation and the action of a policy of another program are made.

use std::collections::BTreeMap;
use std::path::Path;
use twinstep_effects::parse_toml;

use serde::Deserialize;

use crate::error::AgentError;

/// Most steps of a history.
const MAX_HISTORY: usize = 100;
/// Largest output of a policy in use; those of walking quadrupeds are within ±4.
const TYPICAL_ACTIONS: f32 = 4.0;

/// Mapping between the observation and action of a policy and those of Twinstep (TOML).
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mapping {
    /// Names of the joints in the order of the policy.
    pub joints: Vec<String>,
    /// Joint offset of an action of 1 [rad]: one number, or one per joint in the order of `joints`.
    pub action_scale: Numbers,
    /// Position gain that the policy was trained with [N·m/rad]: one number, or one per joint in the order of `joints`.
    pub kp: Numbers,
    /// Velocity gain that the policy was trained with [N·m·s/rad]: as `kp`.
    pub kd: Numbers,
    /// Rate of the policy [Hz].
    pub policy_hz: f64,
    /// Joint positions to which actions and observed positions are relative, by joint [rad].
    pub default_pose: BTreeMap<String, f64>,
    /// Lowest and highest output of the network; it is clipped before the scale, as legged_gym does. Default: none.
    #[serde(default)]
    pub action_clip: Option<[f32; 2]>,
    /// Largest joint offset that an endpoint with this contract lets the policy command [rad]. Default: four times the
    /// largest action scale.
    #[serde(default)]
    pub max_offset: Option<f32>,
    /// Terms of the observation, in order.
    pub observation: Vec<Term>,
    /// Earlier observations in the input of the network. Default: none.
    #[serde(default)]
    pub history: Option<History>,
    /// Further inputs of the network, by name, such as a history apart from the present observation.
    #[serde(default)]
    pub input: BTreeMap<String, InputTable>,
    /// Inputs that are the state of a recurrent network. Default: those that an output of the same shape follows.
    #[serde(default)]
    pub state: Vec<StatePair>,
}

/// A further input of the network.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputTable {
    /// Terms of this input, in order. Default: those of the mapping.
    #[serde(default)]
    pub observation: Vec<Term>,
    /// Earlier observations in this input. Default: none.
    #[serde(default)]
    pub history: Option<History>,
}

/// An input that is the state of a recurrent network, and the output that is the state after the step. It is 0 after a reset.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StatePair {
    /// Name of the input.
    pub input: String,
    /// Name of the output.
    pub output: String,
}

/// A term of the observation.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Term {
    /// The quantity.
    pub term: TermName,
    /// Factor: one number, or one per entry of the term. −1 reverses a sign. Default: 1.
    #[serde(default = "one")]
    pub scale: Numbers,
    /// Lowest and highest value before the scale, as in Isaac Lab. Default: none.
    #[serde(default)]
    pub clip: Option<[f32; 2]>,
    /// Number of steps of this term, with the present one. Default: that of `[history]`.
    #[serde(default)]
    pub history: Option<usize>,
    /// Period of `gait_phase` [s].
    #[serde(default)]
    pub period: Option<f64>,
    /// `gait_phase` is 0 while the norm of the velocity command is smaller than this. Default: never.
    #[serde(default)]
    pub still_below: Option<f32>,
    /// Entries of `constant`.
    #[serde(default)]
    pub values: Vec<f32>,
}

impl Term {
    /// Returns the number of entries for a robot with `joints` joints.
    pub fn len(&self, joints: usize) -> usize {
        match self.term {
            TermName::JointPosition
            | TermName::AbsoluteJointPosition
            | TermName::JointVelocity
            | TermName::PreviousAction => joints,
            TermName::GaitPhase => 2,
            TermName::Constant => self.values.len(),
            _ => 3,
        }
    }
}

/// Quantity that a policy observes, in the unit and frame of Twinstep.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TermName {
    /// Velocity of the base in the base frame [m/s]. Only simulators give it.
    BaseLinearVelocity,
    /// Angular velocity of the base in the base frame [rad/s].
    BaseAngularVelocity,
    /// Unit vector of gravity in the base frame: (0, 0, −1) when level.
    ProjectedGravity,
    /// Velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
    VelocityCommand,
    /// Joint positions relative to the policy's default pose [rad].
    JointPosition,
    /// Joint positions [rad].
    AbsoluteJointPosition,
    /// Joint velocities [rad/s].
    JointVelocity,
    /// Output of the network in the previous step; 0 after a reset.
    PreviousAction,
    /// Sine and cosine of a clock that is 0 at the reset, with the period `period`.
    GaitPhase,
    /// The numbers `values`.
    Constant,
}

impl TermName {
    /// Returns the name of the quantity in the spec of an endpoint.
    pub fn name(self) -> &'static str {
        match self {
            Self::BaseLinearVelocity => "base_linear_velocity",
            Self::BaseAngularVelocity => "base_angular_velocity",
            Self::ProjectedGravity => "projected_gravity",
            Self::VelocityCommand => "velocity_command",
            Self::JointPosition => "joint_position",
            Self::AbsoluteJointPosition => "absolute_joint_position",
            Self::JointVelocity => "joint_velocity",
            Self::PreviousAction => "previous_action",
            Self::GaitPhase => "gait_phase",
            Self::Constant => "constant",
        }
    }
}

/// Earlier observations in the input of the network. After a reset all steps are the first observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct History {
    /// Number of steps, with the present one.
    pub length: usize,
    /// What follows what.
    pub layout: HistoryLayout,
    /// Order of the steps.
    pub order: HistoryOrder,
}

/// What follows what in the input of a network with history.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HistoryLayout {
    /// All steps of the first term, then all of the second: Isaac Lab, mjlab.
    Terms,
    /// All terms of one step, then all of the next step: legged_gym and its descendants.
    Frames,
}

/// Order of the steps in a history.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HistoryOrder {
    /// The present step is last.
    OldestFirst,
    /// The present step is first.
    NewestFirst,
}

/// One number for all entries, or one for each.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged, expecting = "expected a number, or a list with one number for each entry")]
pub enum Numbers {
    /// The same number for all entries.
    Uniform(f32),
    /// One number for each entry.
    Each(Vec<f32>),
}

impl Numbers {
    /// Returns the number of entry `index`.
    pub fn of(&self, index: usize) -> f32 {
        match self {
            Self::Uniform(number) => *number,
            Self::Each(numbers) => numbers[index],
        }
    }

    fn check(&self, key: &str, len: usize) -> Result<(), String> {
        let numbers = match self {
            Self::Uniform(number) => std::slice::from_ref(number),
            Self::Each(numbers) if numbers.len() == len => numbers,
            Self::Each(numbers) => {
                return Err(format!("`{key}` has {} numbers; 1 or {len} are expected", numbers.len()));
            }
        };
        match numbers.iter().find(|number| !number.is_finite() || **number == 0.0) {
            Some(number) => Err(format!("`{key}` has {number}; finite and not 0 is expected")),
            None => Ok(()),
        }
    }
}

fn one() -> Numbers {
    Numbers::Uniform(1.0)
}

impl Mapping {
    /// Reads and checks a mapping file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, AgentError> {
        let path = path.as_ref();
        let failed = |reason: String| AgentError::Mapping { path: path.to_owned(), reason };
        let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
        Self::parse(&text).map_err(failed)
    }

    /// Parses and checks the text of a mapping file. The error says what is wrong.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mapping: Self = parse_toml(text).map_err(|error| error.to_string().trim_end().to_owned())?;
        mapping.check()?;
        Ok(mapping)
    }

    /// Returns the terms and the history of an input of the network; `None` is the one that `[[observation]]` describes.
    pub fn terms(&self, input: Option<&str>) -> (&[Term], Option<History>) {
        match input.and_then(|name| self.input.get(name)) {
            Some(table) if table.observation.is_empty() => (&self.observation, table.history),
            Some(table) => (&table.observation, table.history),
            None => (&self.observation, self.history),
        }
    }

    /// Returns the number of steps of a term of `[[observation]]`.
    pub fn steps(&self, term: &Term) -> usize {
        steps(term, self.history)
    }

    /// Returns the length of the input that `[[observation]]` describes.
    pub fn input_len(&self) -> usize {
        self.len_of(None)
    }

    /// Returns the length of an input of the network.
    pub fn len_of(&self, input: Option<&str>) -> usize {
        let (terms, history) = self.terms(input);
        terms.iter().map(|term| steps(term, history) * term.len(self.joints.len())).sum()
    }

    /// Returns the largest joint offset that an endpoint should let the policy command [rad].
    pub fn max_offset(&self) -> f32 {
        let largest = (0..self.joints.len()).map(|index| self.action_scale.of(index).abs()).fold(0.0, f32::max);
        self.max_offset.unwrap_or(TYPICAL_ACTIONS * largest)
    }

    fn check(&self) -> Result<(), String> {
        self.check_joints()?;
        for (key, numbers) in [("kp", &self.kp), ("kd", &self.kd)] {
            numbers.check(key, self.joints.len())?;
            if let Some(value) = (0..self.joints.len()).map(|index| numbers.of(index)).find(|value| *value < 0.0) {
                return Err(format!("`{key}` has {value}; numbers greater than 0 are expected"));
            }
        }
        for (key, value) in [("policy_hz", Some(self.policy_hz)), ("max_offset", self.max_offset.map(f64::from))] {
            if let Some(value) = value.filter(|value| !(value.is_finite() && *value > 0.0)) {
                return Err(format!("`{key}` = {value}; a finite number greater than 0 is expected"));
            }
        }
        self.action_scale.check("action_scale", self.joints.len())?;
        check_range("action_clip", self.action_clip)?;
        if self.observation.is_empty() {
            return Err("`observation` has no terms; at least one [[observation]] is expected".to_owned());
        }
        let inputs = std::iter::once(None).chain(self.input.keys().map(|name| Some(name.as_str())));
        for input in inputs {
            let (terms, history) = self.terms(input);
            let place = input.map_or_else(String::new, |name| format!("input.{name}: "));
            for term in terms {
                check_term(term, history, self.joints.len()).map_err(|problem| format!("{place}{problem}"))?;
            }
        }
        Ok(())
    }

    fn check_joints(&self) -> Result<(), String> {
        for (index, joint) in self.joints.iter().enumerate() {
            if self.joints[..index].contains(joint) {
                return Err(format!("`joints` has {joint} twice"));
            }
            match self.default_pose.get(joint) {
                None => return Err(format!("`default_pose` has no {joint}, which is in `joints`")),
                Some(q) if !q.is_finite() => return Err(format!("`default_pose.{joint}` = {q} is not finite")),
                Some(_) => {}
            }
        }
        match self.default_pose.keys().find(|joint| !self.joints.contains(joint)) {
            Some(other) => Err(format!("`default_pose` has {other}, which is not in `joints`")),
            None => Ok(()),
        }
    }
}

/// Returns the number of steps of a term in an input with this history.
pub fn steps(term: &Term, history: Option<History>) -> usize {
    term.history.or(history.map(|history| history.length)).unwrap_or(1)
}

fn check_range(key: &str, range: Option<[f32; 2]>) -> Result<(), String> {
    match range {
        Some([low, high]) if !low.is_finite() || !high.is_finite() || low >= high => {
            Err(format!("`{key}` is [{low}, {high}]; the first must be less than the second"))
        }
        _ => Ok(()),
    }
}

fn check_term(term: &Term, history: Option<History>, joints: usize) -> Result<(), String> {
    let name = term.term.name();
    match (term.term, term.period) {
        (TermName::GaitPhase, None) => return Err(format!("{name} has no `period`, the time of a cycle [s]")),
        (TermName::GaitPhase, Some(period)) if !(period.is_finite() && period > 0.0) => {
            return Err(format!("`period` of {name} is {period}; a finite number greater than 0 is expected"));
        }
        (TermName::Constant, _) if term.values.is_empty() || term.values.iter().any(|value| !value.is_finite()) => {
            return Err(format!("`values` of {name} must be finite numbers, one for each entry"));
        }
        (TermName::GaitPhase | TermName::Constant, _) => {}
        (_, Some(_)) => return Err(format!("{name} has a `period`, which is for gait_phase")),
        _ => {}
    }
    if term.term != TermName::Constant && !term.values.is_empty() {
        return Err(format!("{name} has `values`, which are for constant"));
    }
    term.scale.check(&format!("scale of {name}"), term.len(joints))?;
    check_range(&format!("clip of {name}"), term.clip)?;
    let steps = steps(term, history);
    if !(1..=MAX_HISTORY).contains(&steps) {
        return Err(format!("`history` of {name} is {steps}; 1 to {MAX_HISTORY} is allowed"));
    }
    match (term.history, history.map(|history| history.layout)) {
        (Some(_), None) => Err(format!("{name} has `history`, but there is no table [history] with its order")),
        (Some(_), Some(HistoryLayout::Frames)) => {
            Err(format!("{name} has its own `history`, which `layout = \"frames\"` does not allow"))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    const TWO_JOINTS: &str = "joints = [\"b\", \"a\"]\naction_scale = 0.25\nkp = 25\nkd = 0.5\npolicy_hz = 50\n\
                              default_pose = { a = 0.1, b = 0.2 }\n";

    fn error(more: &str, from: &str, to: &str) -> String {
        let text = format!("{TWO_JOINTS}{more}[[observation]]\nterm = \"joint_position\"\n");
        Mapping::parse(&text.replace(from, to)).expect_err("invalid")
    }

    #[test]
    fn length_of_the_input_is_that_of_all_steps() {
        let text = format!(
            "{TWO_JOINTS}[history]\nlength = 3\nlayout = \"terms\"\norder = \"oldest_first\"\n[[observation]]\n\
             term = \"joint_position\"\n[[observation]]\nterm = \"velocity_command\"\nhistory = 1\n"
        );
        assert_eq!(Mapping::parse(&text).expect("valid").input_len(), 3 * 2 + 3);
    }

    #[test]
    fn errors_name_the_key_its_value_and_what_is_allowed() {
        expect!["`kp` has -25; numbers greater than 0 are expected"].assert_eq(&error("", "kp = 25", "kp = -25"));
        expect!["`joints` has a twice"].assert_eq(&error("", "\"b\"", "\"a\""));
        expect!["`default_pose` has no b, which is in `joints`"].assert_eq(&error("", ", b = 0.2", ""));
        expect!["`default_pose` has c, which is not in `joints`"].assert_eq(&error("", "0.1,", "0.1, c = 0,"));
        expect!["`action_scale` has 3 numbers; 1 or 2 are expected"].assert_eq(&error("", "0.25", "[1, 2, 3]"));
        let own_history = |more| error(more, "position\"", "position\"\nhistory = 2");
        expect!["joint_position has `history`, but there is no table [history] with its order"]
            .assert_eq(&own_history(""));
        let frames = "[history]\nlength = 3\nlayout = \"frames\"\norder = \"newest_first\"\n";
        expect![[r#"joint_position has its own `history`, which `layout = "frames"` does not allow"#]]
            .assert_eq(&own_history(frames));
        expect!["`history` of joint_position is 0; 1 to 100 is allowed"].assert_eq(&error(
            &frames.replace('3', "0"),
            "",
            "",
        ));
        let clip = "position\"\nclip = [1, -1]";
        expect!["`clip of joint_position` is [1, -1]; the first must be less than the second"].assert_eq(&error(
            "",
            "position\"",
            clip,
        ));
        let unknown = error("", "joint_position", "height_scan");
        assert!(unknown.contains("unknown variant `height_scan`, expected one of `base_linear_velocity`"), "{unknown}");
    }
}
