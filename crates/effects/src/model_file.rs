//! Model file: a nominal robot and a list of effects, in TOML. Servers simulate it; diagnosis adds effects to it.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;
use toml::{Table, Value};

use crate::nominal::{ControlTable, JointsTable, NominalRobot, NominalRobotError, is_robot_file};
use crate::{CATALOGUE, Effect, EffectEntry, EntryError, Parameter, Scope, apply_effects};
use twinstep_model::RobotModel;

/// Interval of a component that was not measured, in a vector with measured components.
const UNBOUNDED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Reason why a model file was rejected.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    /// The file could not be read.
    #[error("cannot read the model file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type.
    #[error("{name}: {message}")]
    Malformed {
        /// The file, or another source of the text.
        name: String,
        /// Problem, with line and column.
        message: String,
    },
    /// The nominal robot is unknown, or its file or tables are not valid.
    #[error("{name}: {cause}")]
    Robot {
        /// The file, or another source of the text.
        name: String,
        /// What is wrong.
        cause: Box<NominalRobotError>,
    },
    /// An entry of `[[effect]]` is wrong.
    #[error("{name}: effect {number}: {problem}")]
    Effect {
        /// The file, or another source of the text.
        name: String,
        /// Number of the entry, from 1.
        number: usize,
        /// Problem of the entry, and what is allowed.
        problem: EffectEntryError,
    },
    /// The robot has an actuator network, but the caller needs analytic actuators.
    #[error(
        "{name}: `[actuator]` is for `twinstep serve` and `twinstep play`; no other command simulates actuator \
         networks. Remove the table to use the analytic actuators with the effects of the file"
    )]
    ActuatorNetwork {
        /// The file, or another source of the text.
        name: String,
    },
    /// Entries cannot be combined.
    #[error("{name}: {cause}")]
    Conflict {
        /// The file, or another source of the text.
        name: String,
        /// Conflicting entry, and the reason.
        cause: EntryError,
    },
}

/// Problem of an entry of a model file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EffectEntryError {
    /// The catalogue has no such effect.
    #[error("`name` = \"{given}\" is not in the catalogue; possible: {}", CATALOGUE.map(|effect| effect.name).join(", "))]
    Unknown {
        /// The name.
        given: String,
    },
    /// A key is missing or of the wrong kind.
    #[error("`{key}` is {found}; expected {expected}")]
    Key {
        /// The key.
        key: String,
        /// Value in the file.
        found: String,
        /// Expected value.
        expected: String,
    },
    /// The effect does not have this key.
    #[error("`{effect}` has no key `{key}`; possible: name, scope, interval, {}", names(effect))]
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

/// Returns the names of an effect's parameters, separated by commas.
fn names(effect: &str) -> String {
    let parameters = Effect::named(effect).map_or(&[][..], |effect| effect.parameters);
    parameters.iter().map(|parameter| parameter.name).collect::<Vec<_>>().join(", ")
}

/// A nominal robot and its effects.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelFile {
    /// The nominal robot. Shared, because diagnosis copies a model for each candidate.
    pub nominal: Arc<NominalRobot>,
    /// Effects, in the order of the file.
    pub effects: Vec<EffectEntry>,
    /// Actuator network that replaces the first stages of the chain from command to torque, if any.
    pub actuator: Option<ActuatorNetworkConfig>,
}

/// Table `[actuator]`: an ensemble of networks that replaces the first stages of the chain from command to torque.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorNetworkConfig {
    /// File of the ensemble. [`ModelFile::load`] makes paths absolute that are relative to the model file.
    pub ensemble: PathBuf,
    /// When a robot samples another member.
    #[serde(default)]
    pub draw: MemberSampling,
    /// True if torque is sampled from the member's Gaussian in every actuator period; false for its mean.
    #[serde(default)]
    pub sample: bool,
}

/// When a robot samples the member of the ensemble that computes its torques.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MemberSampling {
    /// At every reset.
    #[default]
    #[serde(rename = "episode")]
    PerEpisode,
    /// In every actuator period (U2E §III-C).
    #[serde(rename = "step")]
    PerStep,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelText {
    robot: String,
    control: Option<ControlTable>,
    joints: Option<JointsTable>,
    #[serde(default)]
    effect: Vec<Table>,
    actuator: Option<ActuatorNetworkConfig>,
}

impl Default for ModelFile {
    /// The ideal Go2.
    fn default() -> Self {
        Self { nominal: Arc::new(NominalRobot::go2()), effects: Vec::new(), actuator: None }
    }
}

impl ModelFile {
    /// Reads a model file, or a robot file (URDF, MJCF) as a model without effects. Paths in it become absolute.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        if is_robot_file(path) {
            return Self::parse(&format!("robot = {}", Value::from(path.display().to_string())), "`--model`");
        }
        let text = std::fs::read_to_string(path)
            .map_err(|source| ModelFileError::Unreadable { path: path.to_owned(), source })?;
        let unreadable = |source| ModelFileError::Unreadable { path: path.to_owned(), source };
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut file = Self::parse_in(folder, &text, &path.display().to_string())?;
        if let Some(actuator) = &mut file.actuator {
            actuator.ensemble = std::path::absolute(folder.join(&actuator.ensemble)).map_err(unreadable)?;
        }
        Ok(file)
    }

    /// Reads a model file that must have analytic actuators. Fails if it has an actuator network.
    pub fn load_without_actuator_network(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        analytic(Self::load(path)?, &path.display().to_string())
    }

    /// Parses the text of a model file. Errors use `name` for the file. Paths are relative to the working directory.
    pub fn parse(text: &str, name: &str) -> Result<Self, ModelFileError> {
        Self::parse_in(Path::new(""), text, name)
    }

    fn parse_in(folder: &Path, text: &str, name: &str) -> Result<Self, ModelFileError> {
        let ModelText { robot, control, joints, effect, actuator } = toml::from_str(text)
            .map_err(|error| ModelFileError::Malformed { name: name.to_owned(), message: error.to_string() })?;
        let nominal = NominalRobot::read(&robot, control, joints, folder)
            .map_err(|cause| ModelFileError::Robot { name: name.to_owned(), cause: Box::new(cause) })?;
        let effects = effect.iter().enumerate().map(|(index, table)| {
            read_entry(table).map_err(|problem| ModelFileError::Effect {
                name: name.to_owned(),
                number: index + 1,
                problem,
            })
        });
        let file = Self { nominal: Arc::new(nominal), effects: effects.collect::<Result<_, _>>()?, actuator };
        match file.robot_model() {
            Ok(_) => Ok(file),
            Err(cause) => Err(ModelFileError::Conflict { name: name.to_owned(), cause }),
        }
    }

    /// Returns the nominal robot with all effects applied.
    pub fn robot_model(&self) -> Result<RobotModel, EntryError> {
        apply_effects(&self.nominal.model, &self.effects)
    }

    /// Returns the text of the file. [`ModelFile::parse`] reads exactly the same model from it.
    pub fn to_toml(&self) -> String {
        let NominalRobot { robot, control, joints, .. } = &*self.nominal;
        let mut text = format!("robot = {}\n", Value::from(robot.clone()));
        let tables =
            [("control", control.as_ref().map(Value::try_from)), ("joints", joints.as_ref().map(Value::try_from))];
        for (name, table) in tables {
            if let Some(Ok(Value::Table(table))) = table {
                write!(text, "\n[{name}]\n{table}").expect("a String takes every text");
            }
        }
        for entry in &self.effects {
            writeln!(text, "\n[[effect]]\nname = \"{}\"\nscope = \"{}\"", entry.effect.name, entry.scope)
                .expect("a String takes every text");
            let mut intervals = Vec::new();
            for (parameter, values) in split_by_parameter(entry.effect, &entry.values) {
                writeln!(text, "{} = {}", parameter.name, toml_value(values)).expect("a String takes every text");
            }
            for (parameter, values) in split_by_parameter(entry.effect, &entry.intervals) {
                if values.iter().any(Option::is_some) {
                    let ends = values.iter().map(|interval| interval.unwrap_or(UNBOUNDED));
                    let [low, high] =
                        [0, 1].map(|end| toml_value(&ends.clone().map(|ends| ends[end]).collect::<Vec<_>>()));
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

/// Splits the values of an effect by parameter.
fn split_by_parameter<'a, T>(effect: &'static Effect, numbers: &'a [T]) -> Vec<(&'static Parameter, &'a [T])> {
    let mut rest = numbers;
    let split = |parameter: &'static Parameter| {
        let (own, after) = rest.split_at(parameter.count);
        rest = after;
        (parameter, own)
    };
    effect.parameters.iter().map(split).collect()
}

/// Returns a TOML number for one value, and a list for several.
fn toml_value(values: &[f64]) -> Value {
    match values {
        [value] => Value::from(*value),
        values => Value::from(values.to_vec()),
    }
}

fn read_entry(table: &Table) -> Result<EffectEntry, EffectEntryError> {
    let text = |key: &str| match table.get(key) {
        Some(Value::String(text)) => Ok(text.clone()),
        other => Err(key_error(key, other, "a string")),
    };
    let given = text("name")?;
    let effect = Effect::named(&given).ok_or(EffectEntryError::Unknown { given })?;
    let known = |key: &str| effect.parameters.iter().any(|parameter| parameter.name == key);
    if let Some(key) = table.keys().find(|key| !["name", "scope", "interval"].contains(&key.as_str()) && !known(key)) {
        return Err(EffectEntryError::UnknownKey { effect: effect.name, key: key.clone() });
    }
    let scope: Scope = text("scope")?.parse().map_err(|_: crate::UnknownScope| {
        let expected = "one of all, hip, thigh, calf, FL, FR, RL, RR, left, right, base, ground, or a joint such \
                            as FL_hip";
        key_error("scope", table.get("scope"), expected)
    })?;
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
        other => return Err(key_error("interval", other, "a table such as { torque_nm = [0.3, 0.5] }")),
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
                    if let Some(expected) = interval_problem(ends) {
                        return Err(key_error(&key, table.get(*name), expected));
                    }
                    intervals.push(Some(ends).filter(|ends| *ends != UNBOUNDED));
                }
            }
            other => return Err(key_error(&key, other, "[low, high]")),
        }
    }
    Ok(intervals)
}

/// Returns what is expected of an interval that is not valid, or `None` if it is valid.
fn interval_problem(ends: [f64; 2]) -> Option<&'static str> {
    let [low, high] = ends;
    if !ends.into_iter().all(f64::is_finite) && ends != UNBOUNDED {
        return Some("two finite numbers, or -inf and inf for a component that was not measured");
    }
    (low > high).then_some("low <= high")
}

/// Reads a number, or a list of `count` numbers.
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
    let expected = if count == 1 { "a number".to_owned() } else { format!("a list of {count} numbers") };
    numbers.ok_or_else(|| key_error(key, given, &expected))
}

fn key_error(key: &str, found: Option<&Value>, expected: &str) -> EffectEntryError {
    let found = found.map_or("missing".to_owned(), ToString::to_string);
    EffectEntryError::Key { key: key.to_owned(), found, expected: expected.to_owned() }
}

/// Reads a model file and returns its robot. Fails if the file has an actuator network.
pub fn load_robot(path: impl AsRef<Path>) -> Result<RobotModel, ModelFileError> {
    let path = path.as_ref();
    composed(&ModelFile::load_without_actuator_network(path)?, &path.display().to_string())
}

/// Parses the text of a model file and returns its robot. Errors use `name` for the file.
pub fn parse_robot(text: &str, name: &str) -> Result<RobotModel, ModelFileError> {
    composed(&analytic(ModelFile::parse(text, name)?, name)?, name)
}

fn analytic(file: ModelFile, name: &str) -> Result<ModelFile, ModelFileError> {
    if file.actuator.is_some() {
        return Err(ModelFileError::ActuatorNetwork { name: name.to_owned() });
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
    use crate::Target;
    use twinstep_model::go2;

    fn check_refusal(text: &str, message: &Expect) {
        let error = parse_robot(text, "robot.toml").expect_err("refused");
        message.assert_eq(&error.to_string());
    }

    #[test]
    fn built_in_robot_is_read_from_one_line() {
        assert_eq!(parse_robot("robot = \"go2\"", "robot.toml").expect("valid"), go2());
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
                unknown field `robto`, expected one of `robot`, `control`, `joints`, `effect`, `actuator`
            "#]],
        );
    }

    #[test]
    fn error_for_an_unknown_robot_lists_the_known_ones() {
        check_refusal(
            "robot = \"spot\"",
            &expect![[
                r#"robot.toml: `robot` = "spot" is unknown; possible: "go2", or a file that ends with .urdf or .xml (MJCF)"#
            ]],
        );
    }

    #[test]
    fn path_of_an_ensemble_is_relative_to_the_model_file_and_becomes_absolute() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("robot.toml");
        std::fs::write(&path, "robot = \"go2\"\n[actuator]\nensemble = \"e.safetensors\"\ndraw = \"step\"")
            .expect("written");
        let file = ModelFile::load(&path).expect("valid");
        let ensemble = folder.path().join("e.safetensors");
        assert_eq!(
            file.actuator,
            Some(ActuatorNetworkConfig { ensemble, draw: MemberSampling::PerStep, sample: false })
        );
        assert_eq!(ModelFile::parse(&file.to_toml(), "again").expect("valid"), file);
        for refusal in [load_robot(&path).map(drop), ModelFile::load_without_actuator_network(&path).map(drop)] {
            let error = refusal.expect_err("refused").to_string();
            assert!(error.contains("robot.toml: `[actuator]` is for `twinstep serve`"), "{error}");
        }
    }

    #[test]
    fn errors_in_the_actuator_table_list_the_allowed_keys_and_values() {
        for (table, expected) in [
            ("ensembles = \"e\"", "unknown field `ensembles`, expected one of `ensemble`, `draw`, `sample`"),
            ("ensemble = \"e\"\ndraw = \"row\"", "unknown variant `row`, expected `episode` or `step`"),
            ("ensemble = \"e\"\nsample = 1", "invalid type: integer `1`, expected a boolean"),
            ("draw = \"step\"", "missing field `ensemble`"),
        ] {
            let text = format!("robot = \"go2\"\n[actuator]\n{table}\n");
            let error = ModelFile::parse(&text, "robot.toml").expect_err("refused").to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn error_for_a_missing_file_contains_its_path() {
        let error = load_robot("/nowhere/robot.toml").expect_err("no such file").to_string();
        assert!(error.starts_with("cannot read the model file /nowhere/robot.toml"), "{error}");
    }

    const FRICTION: &str = "robot = \"go2\"\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"RR_thigh\"\n";

    #[test]
    fn effect_with_an_interval_is_applied_to_the_robot() {
        let text = format!("{FRICTION}torque_nm = 0.40\ninterval = {{ torque_nm = [0.36, 0.44] }}\n");
        let file = ModelFile::parse(&text, "robot.toml").expect("valid");
        assert_eq!(file.effects[0].intervals, [Some([0.36, 0.44])]);
        let robot = file.robot_model().expect("no conflict");
        assert_eq!(robot.joints.map(|joint| joint.coulomb_friction)[10], 0.4);
        assert_eq!(robot.joints.map(|joint| joint.coulomb_friction).iter().sum::<f64>(), 0.4);
    }

    #[test]
    fn errors_in_an_effect_contain_the_allowed_values() {
        check_refusal(
            &FRICTION.replace("coulomb_friction", "coulomb"),
            &expect![[
                r#"robot.toml: effect 1: `name` = "coulomb" is not in the catalogue; possible: command_delay, encoder_offset, pd_gain, torque_saturation, supply_sag, thermal_derating, torque_delay, torque_speed_limit, torque_dead_zone, drive_lag, torque_sensor_delay, torque_gain, torque_ripple, backlash, joint_elasticity, coulomb_friction, viscous_friction, stribeck_friction, load_friction, armature, joint_spring, payload, com_shift, inertia, ground_friction, ground_stiffness, gyro_bias"#
            ]],
        );
        check_refusal(FRICTION, &expect![[r#"robot.toml: effect 1: `torque_nm` is missing; expected a number"#]]);
        check_refusal(
            &format!("{FRICTION}torque_nm = \"much\""),
            &expect![[r#"robot.toml: effect 1: `torque_nm` is "much"; expected a number"#]],
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
                r#"robot.toml: effect 1: `coulomb_friction` has no key `torque`; possible: name, scope, interval, torque_nm"#
            ]],
        );
        check_refusal(
            &format!("{FRICTION}torque_nm = 1\ninterval = {{ torque_nm = [2, 1] }}"),
            &expect![[r#"robot.toml: effect 1: `interval.torque_nm` is [2, 1]; expected low <= high"#]],
        );
        check_refusal(
            &FRICTION.replace("RR_thigh", "RR_knee"),
            &expect![[
                r#"robot.toml: effect 1: `scope` is "RR_knee"; expected one of all, hip, thigh, calf, FL, FR, RL, RR, left, right, base, ground, or a joint such as FL_hip"#
            ]],
        );
    }

    const SHIFT: &str =
        "robot = \"go2\"\n[[effect]]\nname = \"com_shift\"\nscope = \"base\"\nshift_m = [0.0, 0.0, 0.0]\n";

    #[test]
    fn interval_of_an_unmeasured_component_is_written_as_minus_to_plus_infinity() {
        let text = format!("{SHIFT}interval = {{ shift_m = [[-0.1, -inf, 0.0], [0.1, inf, 0.0]] }}\n");
        let file = ModelFile::parse(&text, "robot.toml").expect("valid");
        assert_eq!(file.effects[0].intervals, [Some([-0.1, 0.1]), None, Some([0.0, 0.0])]);
        assert!(file.to_toml().contains("[[-0.1, -inf, 0.0], [0.1, inf, 0.0]]"), "{}", file.to_toml());
        check_refusal(
            &format!("{SHIFT}interval = {{ shift_m = [[-0.1, nan, 0.0], [0.1, inf, 0.0]] }}\n"),
            &expect![[
                r#"robot.toml: effect 1: `interval.shift_m` is [[-0.1, nan, 0.0], [0.1, inf, 0.0]]; expected two finite numbers, or -inf and inf for a component that was not measured"#
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
                    Target::Bodies | Target::Imu => Scope::Base,
                    Target::Ground => Scope::Ground,
                };
                let parameters =
                    effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter, parameter.count));
                let values = parameters.zip(shares).map(|(parameter, share)| {
                    let [low, high] = parameter.prior_range;
                    low + share * (high - low)
                });
                let mut entry = EffectEntry::new(effect, scope, values.collect()).expect("prior values are allowed");
                // A random subset of the components has an interval.
                let interval =
                    |(bit, value): (usize, &f64)| (measured >> bit & 1 == 1).then_some([value - 0.1, value + 0.1]);
                entry.intervals = entry.values.iter().enumerate().map(interval).collect();
                entry
            },
        )
    }

    proptest! {
        #[test]
        fn written_model_files_are_read_back_unchanged(entries in prop::collection::vec(some_entry(), 0..6)) {
            let file = ModelFile { effects: entries, ..ModelFile::default() };
            // Two ripples on one joint may conflict; such a file is not valid.
            if file.robot_model().is_ok() {
                prop_assert_eq!(ModelFile::parse(&file.to_toml(), "written").expect("valid"), file);
            }
        }
    }
}
