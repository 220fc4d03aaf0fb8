//! Bodies and frames of MJCF files, from one body outwards.

use std::collections::BTreeSet;

use glam::{DAffine3, DMat3, DVec3};
use roxmltree::Node;
use twinstep_model::{BaseMount, FreeJoint, RigidBody, TreeShapeKind};

use super::actuators::Actuators;
use super::compiler::{MassSource, Settings};
use super::defaults::Classes;
use super::element::Element;
use super::joints::BodyJoint;
use super::meshes::Meshes;
use super::{geoms, joints};
use crate::RobotFileError;
use crate::orientation::ORIENTATIONS;
use crate::tree_builder::TreeBuilder;
use crate::xml::{child, unsupported, vector};

const OF_BODY: [&str; 7] = ["name", "childclass", "pos", "user", "gravcomp", "mocap", "sleep"];
const OF_INERTIAL: [&str; 4] = ["pos", "mass", "diaginertia", "fullinertia"];
/// Elements of bodies that are not part of the robot's mechanics.
const WITHOUT_EFFECT: [&str; 3] = ["site", "camera", "light"];

/// Descends into bodies.
pub struct Reader<'a, 'b> {
    /// Settings of the compiler.
    pub settings: &'b Settings,
    /// Default classes.
    pub classes: &'b Classes<'a>,
    /// Actuators of all joints.
    pub actuators: &'b Actuators,
    /// Meshes by name.
    pub meshes: &'b Meshes<'b>,
    /// Shapes that touch the ground whatever their contact bits.
    pub paired: &'b BTreeSet<String>,
    /// What was read so far.
    pub tree: TreeBuilder,
}

/// A body or frame with what it inherits.
#[derive(Clone, Copy)]
pub struct Place<'a> {
    /// The element.
    pub node: Node<'a, 'a>,
    /// Pose in the body of the tree that it belongs to.
    pub pose: DAffine3,
    /// Class of the elements in it.
    pub class: &'a str,
}

/// Returns the joints of a body, also those in frames, without those of bodies below it.
pub fn joints_of<'a>(body: Node<'a, 'a>) -> Vec<Node<'a, 'a>> {
    let mut joints = Vec::new();
    for node in body.children() {
        match node.tag_name().name() {
            "joint" | "freejoint" => joints.push(node),
            "frame" => joints.extend(joints_of(node)),
            _ => {}
        }
    }
    joints
}

/// Returns true if a body or one below it has a joint.
pub fn moves(body: Node) -> bool {
    body.descendants().any(|node| node.has_tag_name("joint") || node.has_tag_name("freejoint"))
}

/// Returns the free joint of a body.
pub fn free_joint<'a>(body: Node<'a, 'a>) -> Option<Node<'a, 'a>> {
    joints_of(body).into_iter().find(|joint| joint.has_tag_name("freejoint") || joint.attribute("type") == Some("free"))
}

/// Returns the name of an element for messages.
pub fn label<'a>(node: Node<'a, '_>) -> &'a str {
    node.attribute("name").unwrap_or("without a name")
}

impl<'a> Reader<'a, '_> {
    /// Reads the body that is the base.
    pub fn start(&mut self, name: &str, robot: Place<'a>, mount: BaseMount) -> Result<(), RobotFileError> {
        let base = Element { node: robot.node, kind: "body", class: &self.classes["main"] };
        let world_from_base = robot.pose * base.pose(self.settings)?;
        self.tree = TreeBuilder::new(name, label(robot.node), Some(mount), world_from_base);
        let class = robot.node.attribute("childclass").unwrap_or(robot.class);
        self.check_body(robot.node)?;
        if let Some(joint) = free_joint(robot.node) {
            self.tree.set_free_joint(self.free_joint(joint, class)?);
        }
        self.fill(Place { node: robot.node, pose: DAffine3::IDENTITY, class }, 0)
    }

    fn check_body(&self, node: Node<'a, 'a>) -> Result<(), RobotFileError> {
        let body = Element { node, kind: "body", class: &self.classes["main"] };
        body.check(&[&OF_BODY, &ORIENTATIONS])?;
        body.check_value("gravcomp", &["0"])?;
        body.check_value("mocap", &["false"])
    }

    /// Reads what a free joint inherits or states, and refuses one that turns the frame of its body.
    fn free_joint(&self, node: Node<'a, 'a>, class: &str) -> Result<FreeJoint, RobotFileError> {
        if node.has_tag_name("freejoint") {
            let joint = Element { node, kind: "freejoint", class: &self.classes["main"] };
            joint.check(&[&["name", "group", "user", "align"]])?;
            joint.check_value("align", &["auto", "false"])?;
            return Ok(FreeJoint::default());
        }
        let joint = Element::new(node, "joint", class, self.classes)?;
        if joint.number("stiffness", 0.0)? != 0.0 {
            return Err(unsupported(node, "`stiffness` of a free joint is not supported: use <freejoint/>"));
        }
        let value = |name: &str| match joint.number(name, 0.0)? {
            value if value >= 0.0 => Ok(value),
            value => Err(unsupported(node, format!("`{name}` of a free joint is {value}; 0 or more expected"))),
        };
        Ok(FreeJoint { armature: value("armature")?, damping: value("damping")?, friction: value("frictionloss")? })
    }

    /// Returns the bodies directly in a body or the world, also those in frames.
    pub fn bodies_of(&self, place: Place<'a>) -> Result<Vec<Place<'a>>, RobotFileError> {
        let mut bodies = Vec::new();
        for node in place.node.children().filter(Node::is_element) {
            if node.has_tag_name("body") {
                bodies.push(Place { node, ..place });
            } else if node.has_tag_name("frame") {
                bodies.extend(self.bodies_of(self.frame(node, place)?)?);
            }
        }
        Ok(bodies)
    }

    /// Returns the place of a frame.
    fn frame(&self, node: Node<'a, 'a>, outer: Place<'a>) -> Result<Place<'a>, RobotFileError> {
        let frame = Element { node, kind: "frame", class: &self.classes["main"] };
        frame.check(&[&["name", "childclass", "pos"], &ORIENTATIONS])?;
        let pose = outer.pose * frame.pose(self.settings)?;
        Ok(Place { node, pose, class: node.attribute("childclass").unwrap_or(outer.class) })
    }

    /// Reads a body that is in body `parent` of the tree: a body of the tree for each of its joints, or a part of the parent.
    pub fn body(&mut self, outer: Place<'a>, parent: usize) -> Result<(), RobotFileError> {
        let node = outer.node;
        self.check_body(node)?;
        let body = Element { node, kind: "body", class: &self.classes["main"] };
        let mut pose = outer.pose * body.pose(self.settings)?;
        let class = node.attribute("childclass").unwrap_or(outer.class);
        if free_joint(node).is_some() {
            return Err(unsupported(node, format!("body `{}` has a free joint below another body", label(node))));
        }
        let mut joints = Vec::new();
        self.joints_in(Place { node, pose: DAffine3::IDENTITY, class }, &mut joints)?;
        let mut index = parent;
        for BodyJoint { joint, anchor, has_solver_settings } in joints {
            if has_solver_settings {
                self.tree.note("solver settings of joint limits and friction are left out");
            }
            // The frame of the new body is at the joint, with the axes of the body.
            let at_joint = pose * DAffine3::from_translation(anchor);
            let parent_from_child = at_joint * joint.parent_from_child;
            let joint = twinstep_model::TreeJoint { parent: index, parent_from_child, ..joint };
            index = self.tree.add_body(label(node), joint);
            pose = DAffine3::from_translation(-anchor);
        }
        self.fill(Place { node, pose, class }, index)
    }

    /// Collects the joints of a body, also those in frames.
    fn joints_in(&self, place: Place<'a>, joints: &mut Vec<BodyJoint>) -> Result<(), RobotFileError> {
        for node in place.node.children().filter(Node::is_element) {
            if node.has_tag_name("joint") {
                let element = Element::new(node, "joint", place.class, self.classes)?;
                joints.push(joints::read(&element, place.pose, self.settings, self.actuators)?);
            } else if node.has_tag_name("frame") {
                self.joints_in(self.frame(node, place)?, joints)?;
            }
        }
        Ok(())
    }

    /// Adds mass, shapes and bodies of a place to body `index`.
    fn fill(&mut self, place: Place<'a>, index: usize) -> Result<(), RobotFileError> {
        let stated = child(place.node, "inertial");
        let weighs_shapes = match self.settings.mass_source {
            MassSource::Auto => stated.is_none(),
            MassSource::Shapes => self.has_shapes(place)?,
            MassSource::Inertial => false,
        };
        if let Some(inertial) = stated.filter(|_| !weighs_shapes) {
            let body = self.inertial(inertial)?;
            self.tree.add_mass(index, place.pose, body);
        }
        self.contents(place, index, weighs_shapes)
    }

    /// Returns true if a body has shapes in the groups that have mass, also in frames.
    fn has_shapes(&self, place: Place<'a>) -> Result<bool, RobotFileError> {
        for node in place.node.children() {
            let found = match node.tag_name().name() {
                "geom" => {
                    let element = Element::new(node, "geom", place.class, self.classes)?;
                    geoms::read(&element, self.settings)?.is_some_and(|geom| geom.is_weighed(self.settings))
                }
                "frame" => self.has_shapes(self.frame(node, place)?)?,
                _ => false,
            };
            if found {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn contents(&mut self, place: Place<'a>, index: usize, weighs_shapes: bool) -> Result<(), RobotFileError> {
        for node in place.node.children().filter(Node::is_element) {
            match node.tag_name().name() {
                "inertial" | "joint" | "freejoint" => {}
                "geom" => self.geom(node, place, index, weighs_shapes)?,
                "body" => self.body(Place { node, ..place }, index)?,
                "frame" => {
                    let inner = self.frame(node, place)?;
                    self.contents(inner, index, weighs_shapes)?;
                }
                name if WITHOUT_EFFECT.contains(&name) => {}
                name => return Err(unsupported(node, format!("<{name}> is not supported"))),
            }
        }
        Ok(())
    }

    fn geom(&mut self, node: Node<'a, 'a>, place: Place<'a>, index: usize, weighs: bool) -> Result<(), RobotFileError> {
        let element = Element::new(node, "geom", place.class, self.classes)?;
        let Some(geom) = geoms::read(&element, self.settings)? else {
            return Err(unsupported(node, "a plane that is part of the robot is not supported"));
        };
        if weighs && let Some(body) = geom.body(node, self.settings)? {
            self.tree.add_mass(index, place.pose, body);
        }
        let is_paired = geom.name.as_ref().is_some_and(|name| self.paired.contains(name));
        if geom.collides || is_paired {
            let name = geom.name.as_deref().unwrap_or_else(|| place.node.attribute("name").unwrap_or("geom"));
            let kind = match (geom.kind, element.attribute("mesh")) {
                // Only a mesh as it is has the bounds of its file.
                (TreeShapeKind::Mesh(_), Some(mesh)) if element.attribute("type") == Some("mesh") => {
                    TreeShapeKind::Mesh(self.meshes.bounds(mesh))
                }
                (kind, _) => kind,
            };
            self.tree.add_shape(name, index, kind, place.pose * geom.pose);
        }
        Ok(())
    }

    fn inertial(&self, node: Node<'a, 'a>) -> Result<RigidBody, RobotFileError> {
        let element = Element { node, kind: "inertial", class: &self.classes["main"] };
        element.check(&[&OF_INERTIAL, &ORIENTATIONS])?;
        let mass = element.numbers::<1>("mass", "a number")?.map(|[mass]| mass);
        let mass = mass.ok_or_else(|| element.error("mass", "a number"))?;
        let inertia = if let Some([xx, yy, zz, xy, xz, yz]) = element.numbers("fullinertia", "six numbers")? {
            if ORIENTATIONS.iter().any(|name| element.attribute(name).is_some()) {
                return Err(unsupported(node, "`fullinertia` and an orientation: remove one"));
            }
            DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
        } else if let Some(moments) = element.numbers("diaginertia", "three numbers")? {
            DMat3::from_diagonal(vector(moments))
        } else {
            return Err(element.error("diaginertia", "three numbers, or six of `fullinertia`,"));
        };
        let own = RigidBody { mass, com: DVec3::ZERO, inertia };
        Ok(crate::inertia::transformed(element.pose(self.settings)?, own))
    }
}
