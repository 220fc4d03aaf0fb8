//! The settings of `<compiler>`.

use roxmltree::Node;

use crate::RobotFileError;
use crate::orientation::Angles;
use crate::xml::{attribute_error, check_attributes, is_same, parse_numbers, unsupported};

/// Attributes that are resolved.
const RESOLVED: [&str; 6] = ["angle", "eulerseq", "autolimits", "inertiafromgeom", "inertiagrouprange", "settotalmass"];
/// Attributes that name folders of meshes, or leave the robot as it is.
const WITHOUT_EFFECT: [&str; 10] = [
    "meshdir",
    "texturedir",
    "assetdir",
    "strippath",
    "discardvisual",
    "fusestatic",
    "usethread",
    "saveinertial",
    "conflict",
    "exactmeshinertia",
];
/// Attributes with the values that leave the robot as it is.
const ONLY: [(&str, &[&str]); 5] = [
    ("coordinate", &["local"]),
    ("boundmass", &["0"]),
    ("boundinertia", &["0"]),
    ("balanceinertia", &["false"]),
    ("alignfree", &["false"]),
];

/// Source of the mass of bodies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MassSource {
    /// `<inertial>`, and shapes where it is missing.
    Auto,
    /// Shapes only.
    Shapes,
    /// `<inertial>` only.
    Inertial,
}

/// Settings of the compiler.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Factor from angles of the file to radians.
    angle_unit: f64,
    eulerseq: String,
    /// A range makes a limit.
    pub autolimits: bool,
    /// Source of the mass of bodies.
    pub mass_source: MassSource,
    /// Lowest and highest group of the shapes that have mass.
    pub mass_groups: [f64; 2],
    /// Mass of the whole robot [kg].
    pub total_mass: Option<f64>,
}

impl Settings {
    /// Reads all elements `<compiler>`; the last one that has an attribute decides.
    pub fn read(root: Node) -> Result<Self, RobotFileError> {
        let all: Vec<Node> = root.children().filter(|node| node.has_tag_name("compiler")).collect();
        for node in &all {
            let limited: Vec<&str> = ONLY.iter().map(|(name, _)| *name).collect();
            check_attributes(*node, &[&RESOLVED, &WITHOUT_EFFECT, &limited])?;
            for (name, values) in ONLY {
                if let Some(value) = node.attribute(name)
                    && !values.iter().any(|other| is_same(value, other))
                {
                    return Err(unsupported(*node, format!("`{name}=\"{value}\"` of <compiler> is not supported")));
                }
            }
            if let Some(part) = node.children().find(|part| part.is_element() && !part.has_tag_name("lengthrange")) {
                let name = part.tag_name().name();
                return Err(unsupported(part, format!("<{name}> of <compiler> is not supported")));
            }
        }
        let given = |name: &str| all.iter().rev().find_map(|node| Some((*node, node.attribute(name)?)));
        let choice = |name: &'static str, values: &[&str], expected: &'static str| match given(name) {
            None => Ok(values[0].to_owned()),
            Some((_, value)) if values.contains(&value) => Ok(value.to_owned()),
            Some((node, _)) => Err(attribute_error(node, name, expected)),
        };
        let radian = choice("angle", &["degree", "radian"], "degree or radian")? == "radian";
        let autolimits = choice("autolimits", &["true", "false"], "true or false")? == "true";
        let mass_source = match choice("inertiafromgeom", &["auto", "true", "false"], "auto, true or false")?.as_str() {
            "true" => MassSource::Shapes,
            "false" => MassSource::Inertial,
            _ => MassSource::Auto,
        };
        let mass_groups = match given("inertiagrouprange") {
            None => [0.0, 5.0],
            Some((node, text)) => {
                parse_numbers(text).ok_or_else(|| attribute_error(node, "inertiagrouprange", "two groups"))?
            }
        };
        let total_mass = match given("settotalmass") {
            None => None,
            Some((node, text)) => {
                let [total]: [f64; 1] =
                    parse_numbers(text).ok_or_else(|| attribute_error(node, "settotalmass", "a number"))?;
                (total > 0.0).then_some(total)
            }
        };
        let angle_unit = if radian { 1.0 } else { std::f64::consts::PI / 180.0 };
        let eulerseq = given("eulerseq").map_or("xyz", |(_, value)| value).to_owned();
        Ok(Self { angle_unit, eulerseq, autolimits, mass_source, mass_groups, total_mass })
    }

    /// Returns how the file writes angles.
    pub fn angles(&self) -> Angles<'_> {
        Angles { unit: self.angle_unit, sequence: &self.eulerseq }
    }
}
