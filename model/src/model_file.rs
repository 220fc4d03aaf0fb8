//! The model file: a nominal robot and a list of effects, in TOML. What a server simulates, and what diagnosis extends.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use toml::{Table, Value};

use crate::effects::{CATALOGUE, Effect, EffectEntry, EntryError, Parameter, Scope, apply_effects};
use crate::{RobotModel, go2};

/// The names that `robot` may have.
const BUILT_IN: [&str; 1] = ["go2"];

/// The interval of a component that nobody measured, where others of its vector were: it may be anything.
const UNBOUNDED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Why a model file was refused.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    /// The file could not be read.
    #[error("cannot read the model file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type. The message has line and column.
    #[error("{name}: {message}")]
    Malformed {
        /// The file, or where else the text came from.
        name: String,
        /// What is wrong and where.
        message: String,
    },
    /// The robot is unknown.
    #[error("{name}: `robot` = \"{robot}\" is unknown; possible: \"{possible}\"", possible = BUILT_IN.join("\", \""))]
    UnknownRobot {
        /// The file, or where else the text came from.
        name: String,
        /// The robot that was asked for.
        robot: String,
    },
    /// An entry of `[[effect]]` is wrong.
    #[error("{name}: effect {number}: {problem}")]
    Effect {
        /// The file, or where else the text came from.
        name: String,
        /// Which, from 1.
        number: usize,
        /// What is wrong with it, and what is allowed.
        problem: EffectEntryError,
    },
    /// The robot's drives are learned, and who asked needs their laws.
    #[error(
        "{name}: `[actuator]` is for `twinstep serve` and `twinstep play`: nothing else runs learned drives; leave it out, \
         and the robot has the drives of its effects"
    )]
    LearnedDrive {
        /// The file, or where else the text came from.
        name: String,
    },
    /// Entries do not go together.
    #[error("{name}: {cause}")]
    Conflict {
        /// The file, or where else the text came from.
        name: String,
        /// Which, and why.
        cause: EntryError,
    },
}

/// What is wrong with an entry of a model file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EffectEntryError {
    /// The catalogue has no such effect.
    #[error("`name` = \"{given}\" is not in the catalogue; possible: {}", CATALOGUE.map(|effect| effect.name).join(", "))]
    Unknown {
        /// The name.
        given: String,
    },
    /// A key is missing or of the wrong kind.
    #[error("`{key}` is {found}; {wanted} is wanted")]
    Key {
        /// The key.
        key: String,
        /// What stands there.
        found: String,
        /// What should.
        wanted: String,
    },
    /// A key that the effect does not have.
    #[error("`{effect}` has no `{key}`; it has name, scope, interval, {}", names(effect))]
    UnknownKey {
        /// The effect.
        effect: &'static str,
        /// The key.
        key: String,
    },
    /// Scope or values are not allowed.
    #[error(transparent)]
    Entry(#[from] EntryError),
}

/// The names of an effect's parameters.
fn names(effect: &str) -> String {
    let parameters = Effect::named(effect).map_or(&[][..], |effect| effect.parameters);
    parameters.iter().map(|parameter| parameter.name).collect::<Vec<_>>().join(", ")
}

/// A nominal robot and the effects that it has.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelFile {
    /// The built-in robot's name.
    pub robot: String,
    /// In the order of the file.
    pub effects: Vec<EffectEntry>,
    /// What drives the robot in place of the chain's first steps, if anything does.
    pub actuator: Option<ActuatorNetworkConfig>,
}

/// The table `[actuator]`: an ensemble of networks in place of the first steps from command to torque.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorNetworkConfig {
    /// The ensemble's file; where the model file has it relative to itself, from the root.
    pub ensemble: PathBuf,
    /// When a robot gets another member.
    #[serde(default)]
    pub draw: MemberSampling,
    /// Whether torque is drawn from the member's Gaussian in every drive period; its mean otherwise.
    #[serde(default)]
    pub sample: bool,
}

/// When the member of an ensemble that drives a robot is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MemberSampling {
    /// When the robot is placed.
    #[default]
    PerEpisode,
    /// In every drive period (U2E §III-C).
    PerStep,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelText {
    robot: String,
    #[serde(default)]
    effect: Vec<Table>,
    actuator: Option<ActuatorNetworkConfig>,
}

impl Default for ModelFile {
    /// The ideal Go2.
    fn default() -> Self {
        Self { robot: "go2".to_owned(), effects: Vec::new(), actuator: None }
    }
}

impl ModelFile {
    /// Reads a model file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path)
            .map_err(|source| ModelFileError::Unreadable { path: path.to_owned(), source })?;
        let unreadable = |source| ModelFileError::Unreadable { path: path.to_owned(), source };
        let mut file = Self::parse(&text, &path.display().to_string())?;
        if let (Some(actuator), Some(folder)) = (&mut file.actuator, path.parent()) {
            // From the root, so that the same model means the same in any folder that a tool writes it to.
            actuator.ensemble = std::path::absolute(folder.join(&actuator.ensemble)).map_err(unreadable)?;
        }
        Ok(file)
    }

    /// Reads a model file for who needs the laws of its drives, and so refuses learned ones.
    pub fn load_without_actuator_network(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        analytic(Self::load(path)?, &path.display().to_string())
    }

    /// Reads the text of a model file; errors call it `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, ModelFileError> {
        let ModelText { robot, effect, actuator } = toml::from_str(text)
            .map_err(|error| ModelFileError::Malformed { name: name.to_owned(), message: error.to_string() })?;
        if !BUILT_IN.contains(&robot.as_str()) {
            return Err(ModelFileError::UnknownRobot { name: name.to_owned(), robot });
        }
        let effects = effect.iter().enumerate().map(|(index, table)| {
            read_entry(table).map_err(|problem| ModelFileError::Effect {
                name: name.to_owned(),
                number: index + 1,
                problem,
            })
        });
        let file = Self { robot, effects: effects.collect::<Result<_, _>>()?, actuator };
        match file.robot_model() {
            Ok(_) => Ok(file),
            Err(cause) => Err(ModelFileError::Conflict { name: name.to_owned(), cause }),
        }
    }

    /// The robot with its effects.
    pub fn robot_model(&self) -> Result<RobotModel, EntryError> {
        apply_effects(&go2(), &self.effects)
    }

    /// The text of the file; reading it gives the same again, to the last bit.
    pub fn to_toml(&self) -> String {
        let mut text = format!("robot = {}\n", Value::from(self.robot.clone()));
        for entry in &self.effects {
            writeln!(text, "\n[[effect]]\nname = \"{}\"\nscope = \"{}\"", entry.effect.name, entry.scope)
                .expect("a String takes every text");
            let mut intervals = Vec::new();
            for (parameter, values) in of_parameters(entry.effect, &entry.values) {
                writeln!(text, "{} = {}", parameter.name, written(values)).expect("a String takes every text");
            }
            for (parameter, values) in of_parameters(entry.effect, &entry.intervals) {
                if values.iter().any(Option::is_some) {
                    let ends = values.iter().map(|interval| interval.unwrap_or(UNBOUNDED));
                    let [low, high] =
                        [0, 1].map(|end| written(&ends.clone().map(|ends| ends[end]).collect::<Vec<_>>()));
                    intervals.push(format!("{} = [{low}, {high}]", parameter.name));
                }
            }
            if !intervals.is_empty() {
                writeln!(text, "interval = {{ {} }}", intervals.join(", ")).expect("a String takes every text");
            }
        }
        if let Some(ActuatorNetworkConfig { ensemble, draw, sample }) = &self.actuator {
            let draw = match draw {
                MemberSampling::PerEpisode => "episode",
                MemberSampling::PerStep => "step",
            };
            let ensemble = Value::from(ensemble.display().to_string());
            writeln!(text, "\n[actuator]\nensemble = {ensemble}\ndraw = \"{draw}\"\nsample = {sample}")
                .expect("a String takes every text");
        }
        text
    }
}

/// The numbers of each parameter.
fn of_parameters<'a, T>(effect: &'static Effect, numbers: &'a [T]) -> Vec<(&'static Parameter, &'a [T])> {
    let mut rest = numbers;
    let split = |parameter: &'static Parameter| {
        let (own, after) = rest.split_at(parameter.count);
        rest = after;
        (parameter, own)
    };
    effect.parameters.iter().map(split).collect()
}

/// One number, or a list.
fn written(values: &[f64]) -> Value {
    match values {
        [value] => Value::from(*value),
        values => Value::from(values.to_vec()),
    }
}

fn read_entry(table: &Table) -> Result<EffectEntry, EffectEntryError> {
    let text = |key: &str| match table.get(key) {
        Some(Value::String(text)) => Ok(text.clone()),
        other => Err(wrong(key, other, "a text")),
    };
    let given = text("name")?;
    let effect = Effect::named(&given).ok_or(EffectEntryError::Unknown { given })?;
    let known = |key: &str| effect.parameters.iter().any(|parameter| parameter.name == key);
    if let Some(key) = table.keys().find(|key| !["name", "scope", "interval"].contains(&key.as_str()) && !known(key)) {
        return Err(EffectEntryError::UnknownKey { effect: effect.name, key: key.clone() });
    }
    let scope: Scope = text("scope")?
        .parse()
        .map_err(|unknown: crate::effects::UnknownScope| wrong("scope", table.get("scope"), &unknown.to_string()))?;
    let mut values = Vec::new();
    for parameter in effect.parameters {
        values.extend(read_numbers(parameter.name, table.get(parameter.name), parameter.count)?);
    }
    let mut entry = EffectEntry::new(effect, scope, values)?;
    entry.intervals = read_intervals(effect, table.get("interval"))?;
    Ok(entry)
}

fn read_intervals(effect: &'static Effect, given: Option<&Value>) -> Result<Vec<Option<[f64; 2]>>, EffectEntryError> {
    let table = match given {
        None => return Ok(vec![None; effect.num_values()]),
        Some(Value::Table(table)) => table,
        other => return Err(wrong("interval", other, "a table such as { torque_nm = [0.3, 0.5] }")),
    };
    if let Some(key) = table.keys().find(|key| effect.parameters.iter().all(|parameter| parameter.name != *key)) {
        return Err(EffectEntryError::UnknownKey { effect: effect.name, key: format!("interval.{key}") });
    }
    let mut intervals = Vec::new();
    for Parameter { name, count, .. } in effect.parameters {
        let key = format!("interval.{name}");
        match table.get(*name) {
            None => intervals.extend(vec![None; *count]),
            Some(Value::Array(ends)) if ends.len() == 2 => {
                let [low, high] =
                    [read_numbers(&key, Some(&ends[0]), *count)?, read_numbers(&key, Some(&ends[1]), *count)?];
                for ends in low.into_iter().zip(high).map(|(low, high)| [low, high]) {
                    if let Some(wanted) = missing_of_interval(ends) {
                        return Err(wrong(&key, table.get(*name), wanted));
                    }
                    intervals.push(Some(ends).filter(|ends| *ends != UNBOUNDED));
                }
            }
            other => return Err(wrong(&key, other, "[low, high]")),
        }
    }
    Ok(intervals)
}

/// What an interval should be and is not.
fn missing_of_interval(ends: [f64; 2]) -> Option<&'static str> {
    let [low, high] = ends;
    if !ends.into_iter().all(f64::is_finite) && ends != UNBOUNDED {
        return Some("a pair of numbers, or -inf and inf where nobody measured,");
    }
    (low > high).then_some("the low end before the high one")
}

/// A number, or a list of `count`.
fn read_numbers(key: &str, given: Option<&Value>, count: usize) -> Result<Vec<f64>, EffectEntryError> {
    let number = |value: &Value| match value {
        Value::Float(value) => Some(*value),
        Value::Integer(value) => Some(*value as f64),
        _ => None,
    };
    let numbers = match (given, count) {
        (Some(value), 1) => number(value).map(|value| vec![value]),
        (Some(Value::Array(list)), _) if list.len() == count => list.iter().map(number).collect(),
        _ => None,
    };
    let wanted = if count == 1 { "a number".to_owned() } else { format!("a list of {count} numbers") };
    numbers.ok_or_else(|| wrong(key, given, &wanted))
}

fn wrong(key: &str, found: Option<&Value>, wanted: &str) -> EffectEntryError {
    let found = found.map_or("missing".to_owned(), ToString::to_string);
    EffectEntryError::Key { key: key.to_owned(), found, wanted: wanted.to_owned() }
}

impl RobotModel {
    /// The robot of a model file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        composed(&ModelFile::load_without_actuator_network(path)?, &path.display().to_string())
    }

    /// The robot of the text of a model file; errors call it `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, ModelFileError> {
        composed(&analytic(ModelFile::parse(text, name)?, name)?, name)
    }
}

fn analytic(file: ModelFile, name: &str) -> Result<ModelFile, ModelFileError> {
    if file.actuator.is_some() {
        return Err(ModelFileError::LearnedDrive { name: name.to_owned() });
    }
    Ok(file)
}

fn composed(file: &ModelFile, name: &str) -> Result<RobotModel, ModelFileError> {
    file.robot_model().map_err(|cause| ModelFileError::Conflict { name: name.to_owned(), cause })
}

#[cfg(test)]
mod tests {
    use expect_test::{Expect, expect};
    use proptest::prelude::*;

    use super::*;
    use crate::effects::Target;

    fn check_refusal(text: &str, message: &Expect) {
        let error = RobotModel::parse(text, "robot.toml").expect_err("refused");
        message.assert_eq(&error.to_string());
    }

    #[test]
    fn built_in_robot_needs_one_line() {
        assert_eq!(RobotModel::parse("robot = \"go2\"", "robot.toml").expect("valid"), go2());
    }

    #[test]
    fn misspelt_key_is_named_with_its_line_and_the_possible_keys() {
        check_refusal(
            "# my robot\nrobto = \"go2\"\n",
            &expect![[r#"
            robot.toml: TOML parse error at line 2, column 1
              |
            2 | robto = "go2"
              | ^^^^^
            unknown field `robto`, expected one of `robot`, `effect`, `actuator`
        "#]],
        );
    }

    #[test]
    fn unknown_robot_is_answered_with_the_known_ones() {
        check_refusal("robot = \"spot\"", &expect![[r#"robot.toml: `robot` = "spot" is unknown; possible: "go2""#]]);
    }

    #[test]
    fn learned_drive_is_read_beside_its_file_and_written_from_the_root() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("robot.toml");
        std::fs::write(&path, "robot = \"go2\"\n[actuator]\nensemble = \"e.safetensors\"\ndraw = \"step\"")
            .expect("written");
        let file = ModelFile::load(&path).expect("valid");
        let ensemble = folder.path().join("e.safetensors");
        assert_eq!(file.actuator, Some(ActuatorNetworkConfig { ensemble, draw: MemberSampling::PerStep, sample: false }));
        assert_eq!(ModelFile::parse(&file.to_toml(), "again").expect("valid"), file);
        for refusal in [RobotModel::load(&path).map(drop), ModelFile::load_without_actuator_network(&path).map(drop)] {
            let error = refusal.expect_err("refused").to_string();
            assert!(error.contains("robot.toml: `[actuator]` is for `twinstep serve`"), "{error}");
        }
    }

    #[test]
    fn misspelt_key_and_draw_of_a_learned_drive_are_answered_with_the_possible_ones() {
        for (key, wanted) in [
            ("ensembles = \"e\"", "unknown field `ensembles`, expected one of `ensemble`, `draw`, `sample`"),
            ("ensemble = \"e\"\ndraw = \"row\"", "unknown variant `row`, expected `episode` or `step`"),
            ("ensemble = \"e\"\nsample = 1", "invalid type: integer `1`, expected a boolean"),
            ("draw = \"step\"", "missing field `ensemble`"),
        ] {
            let text = format!("robot = \"go2\"\n[actuator]\n{key}\n");
            let error = ModelFile::parse(&text, "robot.toml").expect_err("refused").to_string();
            assert!(error.contains(wanted), "{error}");
        }
    }

    #[test]
    fn missing_file_is_named() {
        let error = RobotModel::load("/nowhere/robot.toml").expect_err("no such file").to_string();
        assert!(error.starts_with("cannot read the model file /nowhere/robot.toml"), "{error}");
    }

    const FRICTION: &str = "robot = \"go2\"\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"RR_thigh\"\n";

    #[test]
    fn effect_with_an_interval_is_in_the_robot() {
        let text = format!("{FRICTION}torque_nm = 0.40\ninterval = {{ torque_nm = [0.36, 0.44] }}\n");
        let file = ModelFile::parse(&text, "robot.toml").expect("valid");
        assert_eq!(file.effects[0].intervals, [Some([0.36, 0.44])]);
        let robot = file.robot_model().expect("no conflict");
        assert_eq!(robot.joints.map(|joint| joint.coulomb_friction)[10], 0.4);
        assert_eq!(robot.joints.map(|joint| joint.coulomb_friction).iter().sum::<f64>(), 0.4);
    }

    #[test]
    fn mistakes_in_an_effect_are_named_with_what_is_allowed() {
        check_refusal(
            &FRICTION.replace("coulomb_friction", "coulomb"),
            &expect![[
                r#"robot.toml: effect 1: `name` = "coulomb" is not in the catalogue; possible: command_delay, encoder_offset, torque_saturation, supply_sag, thermal_derating, torque_delay, torque_speed_limit, drive_lag, torque_sensor_delay, torque_gain, torque_ripple, backlash, joint_elasticity, coulomb_friction, viscous_friction, stribeck_friction, load_friction, armature, joint_spring, payload, com_shift, inertia, ground_friction, ground_stiffness, gyro_bias"#
            ]],
        );
        check_refusal(FRICTION, &expect![[r#"robot.toml: effect 1: `torque_nm` is missing; a number is wanted"#]]);
        check_refusal(
            &format!("{FRICTION}torque_nm = \"much\""),
            &expect![[r#"robot.toml: effect 1: `torque_nm` is "much"; a number is wanted"#]],
        );
        check_refusal(
            &format!("{FRICTION}torque_nm = -1"),
            &expect![[
                r#"robot.toml: effect 1: `coulomb_friction` on RR_thigh: `torque_nm` = -1 is not allowed: 0 to 20"#
            ]],
        );
        check_refusal(
            &format!("{FRICTION}torque_nm = 1\ntorque = 1"),
            &expect![[
                r#"robot.toml: effect 1: `coulomb_friction` has no `torque`; it has name, scope, interval, torque_nm"#
            ]],
        );
        check_refusal(
            &format!("{FRICTION}torque_nm = 1\ninterval = {{ torque_nm = [2, 1] }}"),
            &expect![[
                r#"robot.toml: effect 1: `interval.torque_nm` is [2, 1]; the low end before the high one is wanted"#
            ]],
        );
        check_refusal(
            &FRICTION.replace("RR_thigh", "RR_knee"),
            &expect![[
                r#"robot.toml: effect 1: `scope` is "RR_knee"; "RR_knee" is no scope; possible: all, hip, thigh, calf, FL, FR, RL, RR, left, right, a joint such as FL_hip, base, ground is wanted"#
            ]],
        );
    }

    const SHIFT: &str =
        "robot = \"go2\"\n[[effect]]\nname = \"com_shift\"\nscope = \"base\"\nshift_m = [0.0, 0.0, 0.0]\n";

    #[test]
    fn component_that_nobody_measured_is_from_minus_to_plus_infinity() {
        let text = format!("{SHIFT}interval = {{ shift_m = [[-0.1, -inf, 0.0], [0.1, inf, 0.0]] }}\n");
        let file = ModelFile::parse(&text, "robot.toml").expect("valid");
        assert_eq!(file.effects[0].intervals, [Some([-0.1, 0.1]), None, Some([0.0, 0.0])]);
        assert!(file.to_toml().contains("[[-0.1, -inf, 0.0], [0.1, inf, 0.0]]"), "{}", file.to_toml());
        check_refusal(
            &format!("{SHIFT}interval = {{ shift_m = [[-0.1, nan, 0.0], [0.1, inf, 0.0]] }}\n"),
            &expect![[
                r#"robot.toml: effect 1: `interval.shift_m` is [[-0.1, nan, 0.0], [0.1, inf, 0.0]]; a pair of numbers, or -inf and inf where nobody measured, is wanted"#
            ]],
        );
    }

    fn some_entry() -> impl Strategy<Value = EffectEntry> {
        let scopes = Scope::of_joints().len();
        (0..CATALOGUE.len(), 0..scopes, prop::array::uniform10(0.0..1.0f64), any::<u16>()).prop_map(
            |(index, scope, shares, measured)| {
                let effect = CATALOGUE[index];
                let scope = match effect.target {
                    Target::Joints => Scope::of_joints()[scope],
                    Target::Supply => Scope::All,
                    Target::Bodies | Target::Base => Scope::Base,
                    Target::Ground => Scope::Ground,
                };
                let parameters =
                    effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter, parameter.count));
                let values = parameters.zip(shares).map(|(parameter, share)| {
                    let [low, high] = parameter.prior_range;
                    low + share * (high - low)
                });
                let mut entry = EffectEntry::new(effect, scope, values.collect()).expect("plausible values are allowed");
                // Any of its components may have been measured.
                let interval =
                    |(bit, value): (usize, &f64)| (measured >> bit & 1 == 1).then_some([value - 0.1, value + 0.1]);
                entry.intervals = entry.values.iter().enumerate().map(interval).collect();
                entry
            },
        )
    }

    proptest! {
        #[test]
        fn file_that_was_written_reads_as_the_same(entries in prop::collection::vec(some_entry(), 0..6)) {
            let file = ModelFile { robot: "go2".to_owned(), effects: entries, actuator: None };
            // Two ripples of one joint may be a conflict; then there is no such file.
            if file.robot_model().is_ok() {
                prop_assert_eq!(ModelFile::parse(&file.to_toml(), "written").expect("valid"), file);
            }
        }
    }
}
