//! Model file: a nominal robot and a list of effects, in TOML. Servers simulate it; diagnosis adds effects to it.
//!
//! - [`effect_table`]: reads and writes the entries `[[effect]]`.
//! - [`actuator_network`]: the table `[actuator]`.
//! - [`error`]: reasons why a model file is rejected.
//! - [`tree`]: model file of a robot of any tree.

mod actuator_network;
mod effect_table;
mod error;
mod tree;
mod tree_drives;
mod tree_shapes;
mod tree_text;

use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

use serde::Deserialize;
use toml::{Table, Value};
use twinstep_model::RobotModel;

pub use actuator_network::{ActuatorNetworkConfig, MemberSampling, NetworkMode};
pub use error::{EffectEntryError, ModelFileError};
pub use tree::{JointEffect, JointScope, TreeModelFile};
pub use tree_shapes::ShapeText;
pub use tree_text::{NominalGain, TreeGroups};

use crate::nominal::{ControlTable, JointsTable, NominalRobot, NominalRobotError, is_robot_file};
use crate::parse_toml;
use crate::shipped_robots::{read_to_string, resolved};
use crate::{EffectEntry, EntryError, apply_effects};
use actuator_network::write_actuator_network;
use effect_table::{read_entry, write_entry};

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
        let path = &*resolved(path.as_ref());
        if is_robot_file(path) {
            return Self::parse(&format!("robot = {}", Value::from(path.display().to_string())), "`--model`");
        }
        let text =
            read_to_string(path).map_err(|source| ModelFileError::Unreadable { path: path.to_owned(), source })?;
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
        if TreeModelFile::is_meant(text) {
            return Err(ModelFileError::OfTree { name: name.to_owned() });
        }
        let ModelText { robot, control, joints, effect, actuator } = parse_toml(text)
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

    /// Returns the model with other gains, rates, action scale and default pose. Keys that `control` lacks keep their values.
    pub fn with_control(&self, control: &ControlTable) -> Result<Self, NominalRobotError> {
        Ok(Self { nominal: Arc::new(self.nominal.with_control(control)?), ..self.clone() })
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
            write_entry(&mut text, entry);
        }
        if let Some(network) = &self.actuator {
            write_actuator_network(&mut text, network);
        }
        text
    }
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
mod tests;
#[cfg(test)]
mod tree_tests;
