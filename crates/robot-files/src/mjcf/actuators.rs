//! Forces that the actuators of MJCF files can exert on joints.

use std::collections::BTreeMap;

use roxmltree::Node;

use super::compiler::Settings;
use super::defaults::{ACTUATOR_ELEMENT, Classes};
use super::element::Element;
use crate::RobotFileError;
use crate::xml::unsupported;

const RESOLVED: [&str; 13] = [
    "name",
    "class",
    "joint",
    "gear",
    "ctrlrange",
    "ctrllimited",
    "forcerange",
    "forcelimited",
    "kp",
    "kv",
    "gainprm",
    "gaintype",
    "biastype",
];
/// How a controller inside the actuator works; Twinstep's controller takes its place.
const OF_THE_CONTROLLER: [&str; 13] = [
    "biasprm",
    "dampratio",
    "timeconst",
    "inheritrange",
    "dyntype",
    "dynprm",
    "actlimited",
    "actrange",
    "actearly",
    "actdim",
    "group",
    "user",
    "lengthrange",
];

/// Lowest and highest force on each joint, and whether a controller was left out.
#[derive(Debug, Default)]
pub struct Actuators {
    efforts: BTreeMap<String, [f64; 2]>,
    /// True if an actuator has a controller inside.
    pub has_controllers: bool,
    /// Position and velocity gain of each joint; `None` if its actuators are not one position controller.
    gains: BTreeMap<String, Option<[f64; 2]>>,
}

impl Actuators {
    /// Reads all actuators.
    pub fn read<'a>(root: Node<'a, 'a>, classes: &Classes<'a>) -> Result<Self, RobotFileError> {
        let settings = Settings::read(root)?;
        let mut read = Self::default();
        let all = root.children().filter(|node| node.has_tag_name("actuator")).flat_map(|node| node.children());
        for node in all.filter(Node::is_element) {
            let element = Element::new(node, "actuator", "main", classes)?;
            read.add(&element, &settings)?;
        }
        Ok(read)
    }

    /// Returns the lowest and the highest force on a joint: the sum of its actuators. `None` if it has none.
    pub fn effort(&self, joint: &str) -> Option<[f64; 2]> {
        self.efforts.get(joint).copied()
    }

    /// Returns position and velocity gain of each joint that one position controller drives.
    pub fn gains(&self) -> BTreeMap<String, [f64; 2]> {
        self.gains.iter().filter_map(|(joint, gains)| Some((joint.clone(), (*gains)?))).collect()
    }

    /// Returns the names of the joints that have actuators.
    pub fn joints(&self) -> impl Iterator<Item = &str> {
        self.efforts.keys().map(String::as_str)
    }

    fn add(&mut self, element: &Element, settings: &Settings) -> Result<(), RobotFileError> {
        let tag = element.node.tag_name().name();
        if !matches!(tag, "general" | "motor" | "position" | "velocity" | "intvelocity") {
            return Err(unsupported(
                element.node,
                format!("<{tag}> is not supported: motors, position and velocity actuators are"),
            ));
        }
        element.check(&[&RESOLVED, &OF_THE_CONTROLLER, &[ACTUATOR_ELEMENT.1]])?;
        let Some(joint) = element.node.attribute("joint") else {
            return Err(unsupported(
                element.node,
                format!("<{tag}> has no `joint`: other transmissions are not supported"),
            ));
        };
        let [gear, ..] = element.up_to::<6>("gear", "up to six numbers")?.unwrap_or([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let inner = self.force(element, tag, settings)?;
        // The controller works with the length of the actuator, which is that of the joint times the gear.
        let gains = position_gains(element, tag)?.map(|gains| gains.map(|gain| gain * gear * gear));
        let is_first = !self.gains.contains_key(joint);
        self.gains.insert(joint.to_owned(), gains.filter(|_| is_first));
        let [low, high] = match element.limits("forcerange", "forcelimited", settings)? {
            Some([low, high]) => [inner[0].clamp(low, high), inner[1].clamp(low, high)],
            None => inner,
        };
        // No force times an infinite one is none.
        let scaled = |force: f64| if gear == 0.0 { 0.0 } else { gear * force };
        let (low, high) = (scaled(low).min(scaled(high)), scaled(low).max(scaled(high)));
        let effort = self.efforts.entry(joint.to_owned()).or_insert([0.0; 2]);
        *effort = [effort[0] + low, effort[1] + high];
        Ok(())
    }

    /// Returns the force before `forcerange`.
    fn force(&mut self, element: &Element, tag: &str, settings: &Settings) -> Result<[f64; 2], RobotFileError> {
        let endless = [f64::NEG_INFINITY, f64::INFINITY];
        let control = element.limits("ctrlrange", "ctrllimited", settings)?.unwrap_or(endless);
        match tag {
            "motor" => Ok(control),
            "position" | "velocity" | "intvelocity" => {
                self.has_controllers = true;
                let has_kp = tag != "velocity";
                let kp = if has_kp { element.number("kp", 1.0)? } else { 0.0 };
                let kv = element.number("kv", if has_kp { 0.0 } else { 1.0 })?;
                Ok(if kp == 0.0 && kv == 0.0 { [0.0; 2] } else { endless })
            }
            _ => self.general(element, control),
        }
    }

    /// Returns the force of a general actuator: its gain times its control, if that is all.
    fn general(&mut self, element: &Element, control: [f64; 2]) -> Result<[f64; 2], RobotFileError> {
        if let Some(shortcut) = element.class.get(&ACTUATOR_ELEMENT).filter(|tag| !matches!(**tag, "general" | "motor"))
        {
            let problem =
                format!("<general> in a class with defaults of <{shortcut}> is not supported: use <{shortcut}>");
            return Err(unsupported(element.node, problem));
        }
        let is = |name: &str, value: &str| element.attribute(name).is_none_or(|given| given == value);
        let is_direct = is("gaintype", "fixed") && is("biastype", "none");
        if !is_direct || !(is("dyntype", "none") || is("dyntype", "filter") || is("dyntype", "filterexact")) {
            self.has_controllers = true;
            return Ok([f64::NEG_INFINITY, f64::INFINITY]);
        }
        let [gain, ..] = element.up_to::<10>("gainprm", "up to ten numbers")?.unwrap_or([1.0; 10]);
        let scaled = control.map(|control| if gain == 0.0 { 0.0 } else { gain * control });
        Ok([scaled[0].min(scaled[1]), scaled[0].max(scaled[1])])
    }
}

/// Returns position and velocity gain of an actuator; `None` if it is no position controller, or if its damping follows from a ratio.
fn position_gains(element: &Element, tag: &str) -> Result<Option<[f64; 2]>, RobotFileError> {
    let first = |name: &str| element.up_to::<10>(name, "up to ten numbers");
    // Shortcuts write their gains into these, so that their defaults are those of one actuator.
    let gain = first("gainprm")?.map(|[gain, ..]| gain);
    let [constant, position, velocity, ..] = first("biasprm")?.unwrap_or([0.0; 10]);
    if tag == "position" {
        let [kp, kv] = [element.number("kp", gain.unwrap_or(1.0))?, element.number("kv", -velocity)?];
        for (name, value) in [("kp", kp), ("kv", kv)] {
            if value < 0.0 && element.attribute(name).is_some() {
                return Err(element.error(name, "0 or more"));
            }
        }
        let has_ratio = element.number("dampratio", 0.0)? != 0.0 || kv < 0.0;
        return Ok((!has_ratio).then_some([kp, kv]));
    }
    let is_fixed = element.attribute("gaintype").is_none_or(|kind| kind == "fixed");
    if tag != "general" || element.attribute("biastype") != Some("affine") || !is_fixed {
        return Ok(None);
    }
    // A positive number is a ratio of the critical damping.
    let is_controller = gain.is_some_and(|gain| gain > 0.0 && position == -gain) && constant == 0.0 && velocity <= 0.0;
    Ok(gain.filter(|_| is_controller).map(|gain| [gain, -velocity]))
}
