//! Joints of MJCF files.

use glam::{DAffine3, DVec3};
use twinstep_model::{JointSpring, TreeJoint, TreeJointKind};

use super::actuators::Actuators;
use super::compiler::Settings;
use super::element::Element;
use crate::RobotFileError;
use crate::xml::vector;

const RESOLVED: [&str; 16] = [
    "name",
    "class",
    "type",
    "pos",
    "axis",
    "range",
    "limited",
    "ref",
    "springref",
    "stiffness",
    "damping",
    "armature",
    "frictionloss",
    "actuatorfrcrange",
    "actuatorfrclimited",
    "springdamper",
];
/// How the solver softens limits and friction, which the engines do in their own way.
const OF_THE_SOLVER: [&str; 5] = ["solreflimit", "solimplimit", "solreffriction", "solimpfriction", "margin"];
const WITHOUT_EFFECT: [&str; 3] = ["group", "user", "actuatorgravcomp"];

/// A joint with the frame in which its position is 0.
pub struct BodyJoint {
    /// The joint; its parent and `parent_from_child` are to be set.
    pub joint: TreeJoint,
    /// Place of the joint in the frame of its body [m].
    pub anchor: DVec3,
    /// True if the solver's settings differ from the default.
    pub has_solver_settings: bool,
}

/// Reads a joint. `frame` is the pose in the body of the `<frame>` around it.
pub fn read(
    element: &Element,
    frame: DAffine3,
    settings: &Settings,
    actuators: &Actuators,
) -> Result<BodyJoint, RobotFileError> {
    element.check(&[&RESOLVED, &OF_THE_SOLVER, &WITHOUT_EFFECT])?;
    element.check_value("springdamper", &["0 0"])?;
    element.check_value("actuatorgravcomp", &["false"])?;
    let kind = match element.attribute("type") {
        None | Some("hinge") => TreeJointKind::Revolute,
        Some("slide") => TreeJointKind::Prismatic,
        Some(_) => return Err(element.error("type", "hinge or slide")),
    };
    let name = element.node.attribute("name").ok_or_else(|| element.error("name", "a name"))?.to_owned();
    // Positions of a slide are in metres, whatever unit angles have.
    let unit = if kind == TreeJointKind::Revolute { settings.angles().unit } else { 1.0 };
    let axis = vector(element.numbers("axis", "three numbers")?.unwrap_or([0.0, 0.0, 1.0]));
    let axis = axis.try_normalize().ok_or_else(|| element.error("axis", "three numbers that are not all zero"))?;
    let range = element.limits("range", "limited", settings)?.map(|range| range.map(|limit| unit * limit));
    let stiffness = element.number("stiffness", 0.0)?;
    let rest = unit * element.number("springref", 0.0)?;
    let of_joint = element.limits("actuatorfrcrange", "actuatorfrclimited", settings)?;
    let effort = match (actuators.effort(&name), of_joint) {
        (Some([low, high]), Some([lowest, highest])) => Some([low.max(lowest), high.min(highest)]),
        (one, other) => one.or(other),
    };
    let reference = unit * element.number("ref", 0.0)?;
    let anchor = frame.transform_point3(vector(element.numbers("pos", "three numbers")?.unwrap_or_default()));
    let joint = TreeJoint {
        name,
        kind,
        parent: 0,
        parent_from_child: DAffine3::IDENTITY,
        axis: frame.matrix3 * axis,
        range: range.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]),
        effort,
        speed_limit: f64::INFINITY,
        armature: element.number("armature", 0.0)?,
        damping: element.number("damping", 0.0)?,
        friction: element.number("frictionloss", 0.0)?,
        spring: JointSpring { stiffness, torque_offset: stiffness * rest },
    };
    let has_solver_settings = OF_THE_SOLVER.iter().any(|name| element.attribute(name).is_some());
    // The body is in its place at the position `ref`.
    let parent_from_child = joint.motion(-reference);
    Ok(BodyJoint { joint: TreeJoint { parent_from_child, ..joint }, anchor, has_solver_settings })
}
