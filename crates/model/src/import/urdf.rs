//! Reader of URDF files.

use std::collections::BTreeSet;

use glam::{DMat3, DQuat, DVec3};
use roxmltree::Node;

use super::ImportError;
use super::description::{Description, Link, LinkJoint, Shape, ShapeKind, Transform};
use super::xml::{attribute_error, child, line, number, optional, required, text, vector};
use crate::RigidBody;

const THREE: &str = "three numbers";
/// Maximum number of links of a file.
const MAX_LINKS: usize = 1000;

/// Reads the element `<robot>`.
pub fn read(robot: Node) -> Result<Description, ImportError> {
    let links: Vec<Node> = robot.children().filter(|node| node.has_tag_name("link")).collect();
    let joints: Vec<Node> = robot.children().filter(|node| node.has_tag_name("joint")).collect();
    if links.len() > MAX_LINKS {
        let problem = format!("the file has {} links; at most {MAX_LINKS} are read", links.len());
        return Err(ImportError::Unsupported { line: line(robot), problem });
    }
    let mut is_child = BTreeSet::new();
    for joint in &joints {
        let link = linked(*joint, "child")?;
        // A link below two joints would be read once for each path to it: 2^n times after n such pairs.
        if !is_child.insert(link) {
            let problem = format!("link `{link}` is the child of two joints: the links are no tree");
            return Err(ImportError::Unsupported { line: line(*joint), problem });
        }
    }
    let mut roots = links.iter().filter(|link| link.attribute("name").is_some_and(|name| !is_child.contains(name)));
    let (Some(root), None) = (roots.next(), roots.next()) else {
        let problem = "the links are not one tree: exactly one link must be no joint's child".to_owned();
        return Err(ImportError::Unsupported { line: line(robot), problem });
    };
    let mut reader = Reader { links: &links, joints: &joints, read: Vec::new() };
    reader.add(text(*root, "name")?, None)?;
    Ok(Description { name: text(robot, "name")?.to_owned(), links: reader.read })
}

struct Reader<'a, 'b> {
    links: &'b [Node<'a, 'a>],
    joints: &'b [Node<'a, 'a>],
    read: Vec<Link>,
}

impl Reader<'_, '_> {
    /// Adds a link that moves relative to its parent, with all links below it.
    fn add(&mut self, name: &str, joint: Option<LinkJoint>) -> Result<(), ImportError> {
        let index = self.read.len();
        if index > self.links.len() {
            let problem = format!("link `{name}` is below itself");
            return Err(ImportError::Unsupported { line: 1, problem });
        }
        self.read.push(Link { name: name.to_owned(), body: None, shapes: Vec::new(), joint });
        self.merge(name, index, Transform::IDENTITY, 0)
    }

    /// Adds the body and the shapes of link `name` to link `index`, in whose frame it has this pose, and continues below.
    fn merge(&mut self, name: &str, index: usize, pose: Transform, depth: usize) -> Result<(), ImportError> {
        let Some(link) = self.links.iter().find(|link| link.attribute("name") == Some(name)) else {
            return Err(ImportError::Link {
                link: name.to_owned(),
                problem: "a joint names it, but it is missing".to_owned(),
            });
        };
        if depth > self.links.len() {
            let problem = format!("link `{name}` is below itself");
            return Err(ImportError::Unsupported { line: line(*link), problem });
        }
        if let Some(inertial) = child(*link, "inertial") {
            self.read[index].add_body(pose.body(body(inertial)?));
        }
        for collision in link.children().filter(|node| node.has_tag_name("collision")) {
            if let Some(kind) = shape_kind(collision)? {
                let pose = pose.after(origin(collision)?);
                self.read[index].shapes.push(Shape { name: name.to_owned(), kind, pose });
            }
        }
        for joint in self.joints {
            if linked(*joint, "parent")? != name {
                continue;
            }
            let (below, at) = (linked(*joint, "child")?, pose.after(origin(*joint)?));
            match text(*joint, "type")? {
                "fixed" => self.merge(below, index, at, depth + 1)?,
                "revolute" | "continuous" => self.add(below, Some(moving(*joint, index, at)?))?,
                _ => return Err(attribute_error(*joint, "type", "fixed, revolute or continuous")),
            }
        }
        Ok(())
    }
}

/// Returns the link that `<parent>` or `<child>` of a joint names.
fn linked<'a>(joint: Node<'a, '_>, side: &str) -> Result<&'a str, ImportError> {
    let node = child(joint, side).ok_or_else(|| {
        let problem = format!("<joint> has no <{side}>");
        ImportError::Unsupported { line: line(joint), problem }
    })?;
    text(node, "link")
}

fn moving(joint: Node, parent: usize, pose: Transform) -> Result<LinkJoint, ImportError> {
    let axis = child(joint, "axis").map_or(Ok([1.0, 0.0, 0.0]), |axis| required(axis, "xyz", THREE))?;
    let limit = child(joint, "limit");
    let of_limit = |attribute: &'static str| -> Result<Option<f64>, ImportError> {
        Ok(limit.map_or(Ok(None), |limit| optional::<1>(limit, attribute, "a number"))?.map(|[value]| value))
    };
    let dynamics = child(joint, "dynamics");
    let of_dynamics = |attribute: &'static str| -> Result<f64, ImportError> {
        Ok(dynamics.map_or(Ok(None), |node| optional::<1>(node, attribute, "a number"))?.map_or(0.0, |[value]| value))
    };
    Ok(LinkJoint {
        name: text(joint, "name")?.to_owned(),
        parent,
        pose,
        axis: vector(axis),
        range: [
            of_limit("lower")?.unwrap_or(-std::f64::consts::PI),
            of_limit("upper")?.unwrap_or(std::f64::consts::PI),
        ],
        torque_limit: of_limit("effort")?,
        speed_limit: of_limit("velocity")?.unwrap_or(f64::INFINITY),
        // The extension of Gazebo and MuJoCo: <dynamics armature="0.01"/>.
        armature: of_dynamics("armature")?,
        damping: of_dynamics("damping")?,
        friction: of_dynamics("friction")?,
    })
}

/// Returns the pose that `<origin>` of an element gives.
fn origin(node: Node) -> Result<Transform, ImportError> {
    let Some(origin) = child(node, "origin") else { return Ok(Transform::IDENTITY) };
    let translation = vector(optional(origin, "xyz", THREE)?.unwrap_or_default());
    let [roll, pitch, yaw] = optional(origin, "rpy", THREE)?.unwrap_or_default();
    // Fixed axes x, y, z.
    let rotation = DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) * DQuat::from_rotation_x(roll);
    Ok(Transform { rotation: DMat3::from_quat(rotation), translation })
}

fn body(inertial: Node) -> Result<RigidBody, ImportError> {
    let missing =
        |name: &str| ImportError::Unsupported { line: line(inertial), problem: format!("<inertial> has no <{name}>") };
    let mass = number(child(inertial, "mass").ok_or_else(|| missing("mass"))?, "value")?;
    let node = child(inertial, "inertia").ok_or_else(|| missing("inertia"))?;
    let [xx, xy, xz] = [number(node, "ixx")?, number(node, "ixy")?, number(node, "ixz")?];
    let [yy, yz, zz] = [number(node, "iyy")?, number(node, "iyz")?, number(node, "izz")?];
    let inertia = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
    Ok(origin(inertial)?.body(RigidBody { mass, com: DVec3::ZERO, inertia }))
}

/// Returns the shape of `<collision>`. Returns `None` for a mesh.
fn shape_kind(collision: Node) -> Result<Option<ShapeKind>, ImportError> {
    let Some(geometry) = child(collision, "geometry") else { return Ok(None) };
    let Some(shape) = geometry.children().find(Node::is_element) else { return Ok(None) };
    Ok(match shape.tag_name().name() {
        "box" => Some(ShapeKind::Box(0.5 * vector(required(shape, "size", THREE)?))),
        "sphere" => Some(ShapeKind::Sphere(number(shape, "radius")?)),
        "cylinder" | "capsule" => {
            let half_length = 0.5 * number(shape, "length")?;
            Some(ShapeKind::Capsule { radius: number(shape, "radius")?, half_length })
        }
        _ => None,
    })
}
