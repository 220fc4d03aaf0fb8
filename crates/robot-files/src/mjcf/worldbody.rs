//! The robot in `<worldbody>`, and what stands beside it.

use glam::DAffine3;
use roxmltree::Node;
use twinstep_model::BaseMount;

use super::actuators::Actuators;
use super::bodies::{Place, Reader, free_joint, joints_of, label, moves};
use super::compiler::Settings;
use super::defaults::Classes;
use super::meshes::Meshes;
use super::pairs::Pairs;
use crate::tree_builder::TreeBuilder;
use crate::xml::{child, unsupported};
use crate::{RobotFile, RobotFileError};

/// Maximum number of elements of `<worldbody>`.
const MAX_ELEMENTS: usize = 20_000;

/// Reads `<worldbody>`: the robot in it, without what never moves beside it.
pub fn read<'a>(
    root: Node<'a, 'a>,
    settings: &Settings,
    classes: &Classes<'a>,
    actuators: &Actuators,
    meshes: &Meshes,
    pairs: &Pairs,
) -> Result<RobotFile, RobotFileError> {
    let name = root.attribute("model").unwrap_or("robot");
    let world = child(root, "worldbody").ok_or_else(|| unsupported(root, "<mujoco> has no <worldbody>"))?;
    if world.descendants().nth(MAX_ELEMENTS).is_some() {
        return Err(unsupported(world, format!("<worldbody> has more than {MAX_ELEMENTS} elements")));
    }
    let place = Place { node: world, pose: DAffine3::IDENTITY, class: "main" };
    let tree = TreeBuilder::new(name, "world", None, DAffine3::IDENTITY);
    let paired = &pairs.with_ground;
    let mut reader = Reader { settings, classes, actuators, meshes, paired, tree };
    let all = reader.bodies_of(place)?;
    let (moving, furniture): (Vec<Place>, Vec<Place>) = all.into_iter().partition(|place| moves(place.node));
    let (robots, objects) = without_objects(moving, actuators);
    let free: Vec<&Place> = robots.iter().filter(|place| free_joint(place.node).is_some()).collect();
    match (&robots[..], &free[..]) {
        ([], _) => return Err(unsupported(world, "<worldbody> has no body with a joint")),
        (_, [one, other, ..]) => {
            let [one, other] = [one, other].map(|place| label(place.node));
            return Err(unsupported(
                world,
                format!("bodies `{one}` and `{other}` both move freely: one robot expected"),
            ));
        }
        ([robot], [_]) => reader.start(name, *robot, BaseMount::Floating)?,
        ([robot], []) if joints_of(robot.node).is_empty() => reader.start(name, *robot, BaseMount::Fixed)?,
        (_, [one]) => {
            let beside = robots.iter().map(|place| label(place.node)).find(|name| *name != label(one.node));
            let problem = format!(
                "body `{}` moves freely, and `{}` moves beside it: one robot expected, and no actuators of anything else",
                label(one.node),
                beside.unwrap_or_default()
            );
            return Err(unsupported(world, problem));
        }
        _ => {
            reader.tree = TreeBuilder::new(name, "world", Some(BaseMount::Fixed), DAffine3::IDENTITY);
            for robot in &robots {
                reader.body(*robot, 0)?;
            }
        }
    }
    for place in objects {
        reader.tree.note(format!("body `{}` has no actuator and is not part of the robot", label(place.node)));
    }
    if pairs.has_own {
        reader.tree.note("contacts between shapes of the robot are left out");
    }
    for place in furniture {
        reader.tree.note(format!("body `{}` never moves and is not part of the robot", label(place.node)));
    }
    if let Some(joint) = actuators.joints().find(|joint| !reader.tree.has_joint(joint)) {
        return Err(unsupported(
            root,
            format!("<actuator> has an actuator of joint `{joint}`, which the robot does not have"),
        ));
    }
    if let Some(total) = settings.total_mass {
        reader.tree.set_total_mass(total);
    }
    if actuators.has_controllers {
        reader.tree.note("controllers inside the actuators of the file are left out: their force limits and their gains, as defaults, are kept");
    }
    reader.tree.finish()
}

/// Returns the bodies that may be the robot, and those that stand or lie beside a robot and that nothing drives.
///
/// They matter only where one body moves freely: bodies that are all fixed to the world are one tree.
fn without_objects<'a>(moving: Vec<Place<'a>>, actuators: &Actuators) -> (Vec<Place<'a>>, Vec<Place<'a>>) {
    let is_free = |place: &Place| free_joint(place.node).is_some();
    let is_driven = |place: &Place| {
        let names = place.node.descendants().filter(|node| node.has_tag_name("joint"));
        let names: Vec<_> = names.filter_map(|joint| joint.attribute("name")).collect();
        actuators.joints().any(|joint| names.contains(&joint))
    };
    if moving.len() < 2 || !moving.iter().any(is_free) || !moving.iter().any(is_driven) {
        return (moving, Vec::new());
    }
    moving.into_iter().partition(is_driven)
}
