//! Reader of MJCF files. Whatever changes the robot is resolved as MuJoCo does, or refused by its name.
//!
//! - [`defaults`]: default classes; [`element`]: an element with its class.
//! - [`compiler`]: the settings of `<compiler>`.
//! - [`worldbody`]: finds the robot; [`bodies`]: descends from its base through bodies and frames. [`joints`], [`geoms`], [`meshes`], [`actuators`],
//!   [`pairs`]: what is in them. [`keyframe`]: the pose at the start.

mod actuators;
mod bodies;
mod compiler;
mod defaults;
mod element;
mod geoms;
mod joints;
mod keyframe;
mod meshes;
mod pairs;
mod worldbody;

use std::collections::BTreeMap;
use std::path::Path;

pub use compiler::{MassSource, Settings};
use roxmltree::Node;

use crate::xml::{is_same, unsupported};
use crate::{FileControl, RobotFile, RobotFileError};

/// Sections that are read, and those that do not describe the robot.
const SECTIONS: [&str; 12] = [
    "compiler",
    "default",
    "worldbody",
    "actuator",
    "asset",
    "option",
    "size",
    "visual",
    "statistic",
    "custom",
    "sensor",
    "keyframe",
];

/// Reads the element `<mujoco>`.
pub fn read<'a>(root: Node<'a, 'a>, folder: Option<&Path>) -> Result<RobotFile, RobotFileError> {
    check_sections(root)?;
    check_options(root)?;
    let settings = Settings::read(root)?;
    let classes = defaults::read(root)?;
    let actuators = actuators::Actuators::read(root, &classes)?;
    let meshes = meshes::Meshes::read(root, folder)?;
    let pairs = pairs::Pairs::read(root)?;
    let mut file = worldbody::read(root, &settings, &classes, &actuators, &meshes, &pairs)?;
    let home = keyframe::home(root).unwrap_or_else(|note| {
        file.notes.push(note);
        BTreeMap::new()
    });
    file.control = FileControl { gains: actuators.gains(), home };
    Ok(file)
}

/// Refuses sections that add forces or constraints, by the name of the first element.
fn check_sections(root: Node) -> Result<(), RobotFileError> {
    for section in root.children().filter(Node::is_element) {
        let name = section.tag_name().name();
        if SECTIONS.contains(&name) {
            continue;
        }
        // Robots have no contacts with themselves, so only the ground is not to be excluded.
        let is_needless = |part: &Node| {
            let bodies = [part.attribute("body1"), part.attribute("body2")];
            let keeps_ground = part.has_tag_name("exclude") && !bodies.contains(&Some("world"));
            keeps_ground || name == "contact" && part.has_tag_name("pair")
        };
        let mut parts = section.children().filter(Node::is_element).filter(|part| !is_needless(part));
        match parts.next() {
            None => {}
            Some(part) => {
                let (inner, labelled) = (part.tag_name().name(), part.attribute("name").unwrap_or("without a name"));
                let why = if name == "equality" { ": closed loops and coupled joints are not supported" } else { "" };
                return Err(unsupported(part, format!("<{inner}> ({labelled}) of <{name}> is not supported{why}")));
            }
        }
    }
    Ok(())
}

/// Forces of the surroundings, with the values that the engines have.
const SURROUNDINGS: [(&str, &str); 4] =
    [("gravity", "0 0 -9.81"), ("density", "0"), ("viscosity", "0"), ("wind", "0 0 0")];
/// Flags without which a part of the mechanics is missing.
const NEEDED: [&str; 9] =
    ["gravity", "limit", "frictionloss", "passive", "spring", "damper", "actuation", "clampctrl", "contact"];

/// Refuses options that change forces on the robot. Those of the solver are the engines' own.
fn check_options(root: Node) -> Result<(), RobotFileError> {
    for option in root.children().filter(|node| node.has_tag_name("option")) {
        for (name, own) in SURROUNDINGS {
            if let Some(value) = option.attribute(name).filter(|value| !is_same(value, own)) {
                let problem = format!("`{name}=\"{value}\"` of <option> is not supported: the engines have \"{own}\"");
                return Err(unsupported(option, problem));
            }
        }
        for flag in option.children().filter(|node| node.has_tag_name("flag")) {
            if let Some(name) = NEEDED.iter().find(|name| flag.attribute(**name) == Some("disable")) {
                return Err(unsupported(flag, format!("`{name}=\"disable\"` of <flag> is not supported")));
            }
        }
    }
    Ok(())
}
