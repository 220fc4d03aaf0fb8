//! Reader of URDF files, which MuJoCo reads too. Links that are fixed to each other are one body.

use std::collections::BTreeSet;
use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};
use roxmltree::Node;
use twinstep_model::{BaseMount, JointSpring, RigidBody, TreeJoint, TreeJointKind, TreeShapeKind};

use crate::inertia::{self, DENSITY, MIN_LENGTH, transformed};
use crate::mesh::MeshFolder;
use crate::mjcf::{MassSource, Settings};
use crate::orientation::from_rpy;
use crate::tree_builder::TreeBuilder;
use crate::xml::{attribute_error, child, line, number, optional, text, unsupported, vector};
use crate::{RobotFile, RobotFileError};

const THREE: &str = "three numbers";
/// Maximum number of links of a file.
const MAX_LINKS: usize = 1000;
/// Size below which a shape has none [m].
const MIN_SIZE: f64 = 2.0 * MIN_LENGTH;
/// Elements that are read. MuJoCo reads no others, so others do not change the robot.
const OF_ROBOT: [&str; 3] = ["link", "joint", "mujoco"];
const OF_LINK: [&str; 3] = ["inertial", "visual", "collision"];
const OF_JOINT: [&str; 6] = ["origin", "parent", "child", "axis", "limit", "dynamics"];
/// Elements that are common in URDF files and describe no mechanics.
const USUAL: [&str; 7] =
    ["material", "transmission", "gazebo", "sensor", "ros2_control", "calibration", "safety_controller"];

/// Reads the element `<robot>`.
pub fn read(robot: Node, folder: Option<&Path>) -> Result<RobotFile, RobotFileError> {
    // MuJoCo's own extension of URDF.
    let extension = child(robot, "mujoco").unwrap_or(robot);
    let settings = Settings::read(extension)?;
    if settings.mass_source != MassSource::Auto {
        return Err(unsupported(
            extension,
            "`inertiafromgeom` of <compiler> in URDF is not supported: state <inertial>",
        ));
    }
    let links: Vec<Node> = robot.children().filter(|node| node.has_tag_name("link")).collect();
    let joints: Vec<Node> = robot.children().filter(|node| node.has_tag_name("joint")).collect();
    let root = root_of(robot, &links, &joints)?;
    let (base, mount, world_from_base) = base_of(root, &links, &joints)?;
    let name = text(robot, "name")?;
    let base_name = text(base, "name")?;
    let tree = TreeBuilder::new(name, base_name, mount, world_from_base);
    let meshes = MeshFolder::new(folder);
    let mut reader = Reader { links: &links, joints: &joints, meshes: &meshes, tree };
    reader.note_others(robot, &OF_ROBOT);
    reader.merge(base_name, 0, DAffine3::IDENTITY, 0)?;
    if let Some(total) = settings.total_mass {
        reader.tree.set_total_mass(total);
    }
    reader.tree.finish()
}

/// Returns the link that is no joint's child.
fn root_of<'a>(robot: Node, links: &[Node<'a, 'a>], joints: &[Node<'a, 'a>]) -> Result<Node<'a, 'a>, RobotFileError> {
    let parts = links.len().max(joints.len());
    if parts > MAX_LINKS {
        return Err(unsupported(robot, format!("the file has {parts} links or joints; at most {MAX_LINKS} are read")));
    }
    if links.is_empty() {
        return Err(unsupported(robot, "it has no <link>: expand a xacro file first (`xacro robot.urdf.xacro`)"));
    }
    let (mut names, mut is_child) = (BTreeSet::new(), BTreeSet::new());
    for link in links {
        let name = text(*link, "name")?;
        if !names.insert(name) {
            return Err(unsupported(*link, format!("two links are named `{name}`")));
        }
    }
    for joint in joints {
        let link = linked(*joint, "child")?;
        // A link below two joints would be read once for each path to it: 2^n times after n such pairs.
        if !is_child.insert(link) {
            return Err(unsupported(
                *joint,
                format!("link `{link}` is the child of two joints: the links are no tree"),
            ));
        }
    }
    let mut roots = links.iter().filter(|link| link.attribute("name").is_some_and(|name| !is_child.contains(name)));
    match (roots.next(), roots.next()) {
        (Some(root), None) => Ok(*root),
        _ => Err(unsupported(robot, "the links are not one tree: exactly one link must be no joint's child")),
    }
}

/// Returns the link of the base, how it is mounted if the file says so, and its pose.
///
/// A root without mass and shape is the world: its joint says whether the base is free, or fixed.
fn base_of<'a>(
    root: Node<'a, 'a>,
    links: &[Node<'a, 'a>],
    joints: &[Node<'a, 'a>],
) -> Result<(Node<'a, 'a>, Option<BaseMount>, DAffine3), RobotFileError> {
    let name = text(root, "name")?;
    let is_empty = child(root, "inertial").is_none() && child(root, "collision").is_none();
    let mut below = joints.iter().filter(|joint| linked(**joint, "parent").is_ok_and(|parent| parent == name));
    let (Some(joint), None, true) = (below.next(), below.next(), is_empty) else {
        return Ok((root, None, DAffine3::IDENTITY));
    };
    let mount = match text(*joint, "type")? {
        "floating" => BaseMount::Floating,
        "fixed" if name == "world" => BaseMount::Fixed,
        _ => return Ok((root, None, DAffine3::IDENTITY)),
    };
    let base = linked(*joint, "child")?;
    Ok((named(links, base)?, Some(mount), origin(*joint)?))
}

fn named<'a>(links: &[Node<'a, 'a>], name: &str) -> Result<Node<'a, 'a>, RobotFileError> {
    links.iter().find(|link| link.attribute("name") == Some(name)).copied().ok_or_else(|| RobotFileError::Link {
        link: name.to_owned(),
        problem: "a joint names it, but it is missing".to_owned(),
    })
}

struct Reader<'a, 'b> {
    links: &'b [Node<'a, 'a>],
    joints: &'b [Node<'a, 'a>],
    meshes: &'b MeshFolder,
    tree: TreeBuilder,
}

impl Reader<'_, '_> {
    /// Adds mass and shapes of link `name` to body `index`, in whose frame it has this pose, and continues below.
    fn merge(&mut self, name: &str, index: usize, pose: DAffine3, depth: usize) -> Result<(), RobotFileError> {
        let link = named(self.links, name)?;
        if depth > self.links.len() {
            return Err(unsupported(link, format!("link `{name}` is below itself")));
        }
        self.note_others(link, &OF_LINK);
        let stated = child(link, "inertial");
        if let Some(inertial) = stated {
            let body = mass(inertial)?;
            // MuJoCo, too, leaves out an inertia without mass that is fixed to another link.
            if body.mass != 0.0 {
                self.tree.add_mass(index, pose, body);
            }
        }
        for collision in link.children().filter(|node| node.has_tag_name("collision")) {
            let Some(kind) = shape_kind(collision, self.meshes)? else { continue };
            let place = pose * origin(collision)?;
            if stated.is_none() {
                self.weigh(collision, kind, index, place)?;
            }
            self.tree.add_shape(name, index, kind, place);
        }
        for joint in self.joints {
            if linked(*joint, "parent")? == name {
                self.joint(*joint, index, pose, depth)?;
            }
        }
        Ok(())
    }

    /// Notes the elements that are not read.
    fn note_others(&mut self, node: Node, read: &[&str]) {
        for part in node.children().filter(Node::is_element) {
            let (name, outer) = (part.tag_name().name(), node.tag_name().name());
            if !read.contains(&name) && !USUAL.contains(&name) {
                self.tree.note(format!("<{name}> of <{outer}> has no meaning in URDF and is left out"));
            }
        }
    }

    /// Adds the mass of a shape of a link without `<inertial>`, as MuJoCo does.
    fn weigh(&mut self, node: Node, kind: TreeShapeKind, index: usize, place: DAffine3) -> Result<(), RobotFileError> {
        let Some(volume) = inertia::volume(kind) else {
            let problem =
                "a mesh whose mass is needed, because its link has no <inertial>, is not supported: state <inertial>";
            return Err(unsupported(node, problem));
        };
        if let Some(body) = inertia::solid(kind, DENSITY * volume) {
            self.tree.add_mass(index, place, body);
        }
        Ok(())
    }

    fn joint(&mut self, joint: Node, index: usize, pose: DAffine3, depth: usize) -> Result<(), RobotFileError> {
        if let Some(mimic) = child(joint, "mimic") {
            return Err(unsupported(mimic, "<mimic> of <joint> is not supported: coupled joints are not"));
        }
        self.note_others(joint, &OF_JOINT);
        let (below, at) = (linked(joint, "child")?, pose * origin(joint)?);
        let kind = match text(joint, "type")? {
            "fixed" => return self.merge(below, index, at, depth + 1),
            "revolute" | "continuous" => TreeJointKind::Revolute,
            "prismatic" => TreeJointKind::Prismatic,
            "floating" => {
                let problem =
                    "`floating` below a link with mass or with other joints is not supported: one robot expected";
                return Err(unsupported(joint, problem));
            }
            _ => return Err(attribute_error(joint, "type", "fixed, revolute, continuous, prismatic or floating")),
        };
        let moving = moving(joint, kind, index, at)?;
        let index = self.tree.add_body(below, moving);
        self.merge(below, index, DAffine3::IDENTITY, depth + 1)
    }
}

/// Returns the link that `<parent>` or `<child>` of a joint names.
fn linked<'a>(joint: Node<'a, '_>, side: &str) -> Result<&'a str, RobotFileError> {
    let node = child(joint, side).ok_or_else(|| unsupported(joint, format!("<joint> has no <{side}>")))?;
    text(node, "link")
}

fn moving(joint: Node, kind: TreeJointKind, parent: usize, pose: DAffine3) -> Result<TreeJoint, RobotFileError> {
    let axis = match child(joint, "axis") {
        None => DVec3::X,
        Some(node) => {
            let axis = optional(node, "xyz", THREE)?.ok_or_else(|| attribute_error(node, "xyz", THREE))?;
            vector(axis)
                .try_normalize()
                .ok_or_else(|| attribute_error(node, "xyz", "three numbers that are not all zero"))?
        }
    };
    let (limit, dynamics) = (child(joint, "limit"), child(joint, "dynamics"));
    let of = |node: Option<Node>, attribute: &str| -> Result<Option<f64>, RobotFileError> {
        Ok(node.map_or(Ok(None), |node| optional::<1>(node, attribute, "a number"))?.map(|[value]| value))
    };
    let stated = (of(limit, "lower")?, of(limit, "upper")?);
    // A bound that is missing is 0, and equal bounds are none, as in MuJoCo.
    let (lower, upper) = (stated.0.unwrap_or(0.0), stated.1.unwrap_or(0.0));
    let is_limited = joint.attribute("type") != Some("continuous") && lower != upper;
    let range = if is_limited { [lower, upper] } else { [f64::NEG_INFINITY, f64::INFINITY] };
    Ok(TreeJoint {
        name: text(joint, "name")?.to_owned(),
        kind,
        parent,
        parent_from_child: pose,
        axis,
        range,
        effort: of(limit, "effort")?.filter(|effort| *effort > 0.0).map(|effort| [-effort, effort]),
        speed_limit: of(limit, "velocity")?.unwrap_or(f64::INFINITY),
        // An extension: <dynamics armature="0.01"/>.
        armature: of(dynamics, "armature")?.unwrap_or(0.0),
        damping: of(dynamics, "damping")?.unwrap_or(0.0),
        friction: of(dynamics, "friction")?.unwrap_or(0.0),
        spring: JointSpring::NONE,
    })
}

/// Returns the pose that `<origin>` of an element gives.
fn origin(node: Node) -> Result<DAffine3, RobotFileError> {
    let Some(origin) = child(node, "origin") else { return Ok(DAffine3::IDENTITY) };
    let translation = vector(optional(origin, "xyz", THREE)?.unwrap_or_default());
    Ok(DAffine3 { matrix3: from_rpy(optional(origin, "rpy", THREE)?.unwrap_or_default()), translation })
}

fn mass(inertial: Node) -> Result<RigidBody, RobotFileError> {
    let missing = |name: &str| unsupported(inertial, format!("<inertial> has no <{name}>"));
    let mass = number(child(inertial, "mass").ok_or_else(|| missing("mass"))?, "value")?;
    let node = child(inertial, "inertia").ok_or_else(|| missing("inertia"))?;
    let [xx, xy, xz] = [number(node, "ixx")?, number(node, "ixy")?, number(node, "ixz")?];
    let [yy, yz, zz] = [number(node, "iyy")?, number(node, "iyz")?, number(node, "izz")?];
    let inertia = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
    Ok(transformed(origin(inertial)?, RigidBody { mass, com: DVec3::ZERO, inertia }))
}

/// Returns the shape of `<collision>`.
fn shape_kind(collision: Node, meshes: &MeshFolder) -> Result<Option<TreeShapeKind>, RobotFileError> {
    let Some(geometry) = child(collision, "geometry") else { return Ok(None) };
    let Some(shape) = geometry.children().find(Node::is_element) else { return Ok(None) };
    let size = |attribute: &str| {
        let value = number(shape, attribute)?;
        if value > MIN_SIZE { Ok(value) } else { Err(attribute_error(shape, attribute, "a size above 0")) }
    };
    Ok(Some(match shape.tag_name().name() {
        "box" => {
            let sizes = optional(shape, "size", THREE)?.filter(|sizes| sizes.iter().all(|size| *size > MIN_SIZE));
            let sizes = sizes.ok_or_else(|| attribute_error(shape, "size", "three sizes above 0"))?;
            TreeShapeKind::Box(0.5 * vector(sizes))
        }
        "sphere" => TreeShapeKind::Sphere(size("radius")?),
        "cylinder" => TreeShapeKind::Cylinder { radius: size("radius")?, half_length: 0.5 * size("length")? },
        "capsule" => TreeShapeKind::Capsule { radius: size("radius")?, half_length: 0.5 * size("length")? },
        "mesh" => {
            let scale = optional(shape, "scale", THREE)?.map_or(DVec3::ONE, vector);
            TreeShapeKind::Mesh(meshes.bounds(text(shape, "filename")?, scale))
        }
        name => {
            return Err(RobotFileError::Unsupported {
                line: line(shape),
                problem: format!("<{name}> is not supported"),
            });
        }
    }))
}
