//! Reader of MJCF files. Defaults, classes, and joint and actuator limits are resolved as MuJoCo does.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};
use roxmltree::Node;

use super::ImportError;
use super::description::{Description, Link, LinkJoint, Shape, ShapeKind, Transform};
use super::xml::{attribute_error, child, line, parse_numbers, rotation_from_wxyz, vector};
use crate::RigidBody;

/// Attributes by element, of one default class.
type Class<'a> = BTreeMap<(&'a str, &'a str), &'a str>;

/// Maximum number of attributes of a default class.
const MAX_ATTRIBUTES: usize = 1000;

/// Reads the element `<mujoco>`.
pub fn read(root: Node) -> Result<Description, ImportError> {
    if let Some(include) = root.descendants().find(|node| node.has_tag_name("include")) {
        let problem = "<include> is not supported: save the model as one file (mujoco's `save_last_xml`)".to_owned();
        return Err(ImportError::Unsupported { line: line(include), problem });
    }
    let mut classes = BTreeMap::from([("main", Class::new())]);
    for default in root.children().filter(|node| node.has_tag_name("default")) {
        let name = default.attribute("class").unwrap_or("main");
        read_class(default, name, &Class::new(), &mut classes)?;
    }
    let compiler =
        |attribute: &str| root.children().filter(|n| n.has_tag_name("compiler")).find_map(|n| n.attribute(attribute));
    // MuJoCo's default is degrees.
    let angle = if compiler("angle") == Some("radian") { 1.0 } else { std::f64::consts::PI / 180.0 };
    let actuators = root.children().filter(|node| node.has_tag_name("actuator")).flat_map(|node| node.children());
    let mut reader =
        Reader { classes, angle, actuators: actuators.filter(Node::is_element).collect(), read: Vec::new() };
    let trunk = child(root, "worldbody")
        .and_then(|world| world.children().find(|node| node.has_tag_name("body") && child(*node, "body").is_some()));
    let Some(trunk) = trunk else {
        let problem = "<worldbody> has no body with legs".to_owned();
        return Err(ImportError::Unsupported { line: line(root), problem });
    };
    let index = reader.push(trunk, None);
    reader.merge(trunk, index, Transform::IDENTITY, "main")?;
    Ok(Description { name: root.attribute("model").unwrap_or("robot").to_owned(), links: reader.read })
}

/// Reads a default class and those below it, which inherit its attributes.
fn read_class<'a>(
    node: Node<'a, 'a>,
    name: &'a str,
    parent: &Class<'a>,
    classes: &mut BTreeMap<&'a str, Class<'a>>,
) -> Result<(), ImportError> {
    let mut class = parent.clone();
    for element in node.children().filter(|child| child.is_element() && !child.has_tag_name("default")) {
        for attribute in element.attributes() {
            class.insert((element.tag_name().name(), attribute.name()), attribute.value());
        }
    }
    for below in node.children().filter(|child| child.has_tag_name("default")) {
        read_class(below, below.attribute("class").unwrap_or(""), &class, classes)?;
    }
    // Each class is a copy of the one above it.
    if class.len() > MAX_ATTRIBUTES {
        let problem = format!("a default class has {} attributes; at most {MAX_ATTRIBUTES} are read", class.len());
        return Err(ImportError::Unsupported { line: line(node), problem });
    }
    classes.insert(name, class);
    Ok(())
}

struct Reader<'a> {
    classes: BTreeMap<&'a str, Class<'a>>,
    /// Factor from angles of the file to radians.
    angle: f64,
    actuators: Vec<Node<'a, 'a>>,
    read: Vec<Link>,
}

/// Element with its default class.
#[derive(Clone, Copy)]
struct Element<'a, 'b> {
    node: Node<'a, 'a>,
    class: &'b Class<'a>,
}

impl Element<'_, '_> {
    /// Returns an attribute of the element or of its class.
    fn attribute(&self, name: &str) -> Option<&str> {
        let default = || self.class.get(&(self.node.tag_name().name(), name)).copied();
        self.node.attribute(name).or_else(default)
    }

    fn numbers<const N: usize>(
        &self,
        name: &'static str,
        expected: &'static str,
    ) -> Result<Option<[f64; N]>, ImportError> {
        let Some(text) = self.attribute(name) else { return Ok(None) };
        // MuJoCo accepts fewer numbers than an attribute can have, such as one of three sizes.
        let mut words: Vec<&str> = text.split_whitespace().collect();
        words.resize(words.len().max(N), "0");
        parse_numbers(&words.join(" ")).map(Some).ok_or_else(|| attribute_error(self.node, name, expected))
    }

    fn number(&self, name: &'static str) -> Result<Option<f64>, ImportError> {
        Ok(self.numbers::<1>(name, "a number")?.map(|[number]| number))
    }

    fn pose(&self) -> Result<Transform, ImportError> {
        for unsupported in ["euler", "axisangle", "xyaxes", "zaxis"] {
            if self.attribute(unsupported).is_some() {
                let problem = format!("`{unsupported}` is not supported; use `quat`");
                return Err(ImportError::Unsupported { line: line(self.node), problem });
            }
        }
        let translation = vector(self.numbers("pos", "three numbers")?.unwrap_or_default());
        let quaternion = self.numbers("quat", "four numbers")?.unwrap_or([1.0, 0.0, 0.0, 0.0]);
        let rotation = rotation_from_wxyz(quaternion)
            .ok_or_else(|| attribute_error(self.node, "quat", "a quaternion that is not zero"))?;
        Ok(Transform { rotation: DMat3::from_quat(rotation), translation })
    }
}

impl<'a> Reader<'a> {
    fn push(&mut self, body: Node, joint: Option<LinkJoint>) -> usize {
        let name = body.attribute("name").unwrap_or("body").to_owned();
        self.read.push(Link { name, body: None, shapes: Vec::new(), joint });
        self.read.len() - 1
    }

    fn element<'b>(&'b self, node: Node<'a, 'a>, childclass: &str) -> Element<'a, 'b> {
        let name = node.attribute("class").unwrap_or(childclass);
        Element { node, class: self.classes.get(name).unwrap_or(&self.classes["main"]) }
    }

    /// Adds a body's mass and shapes to link `index`, in whose frame it has this pose, and continues below.
    fn merge(
        &mut self,
        body: Node<'a, 'a>,
        index: usize,
        pose: Transform,
        childclass: &'a str,
    ) -> Result<(), ImportError> {
        let childclass = body.attribute("childclass").unwrap_or(childclass);
        for node in body.children().filter(Node::is_element) {
            match node.tag_name().name() {
                "inertial" => {
                    let own = pose.body(mass(self.element(node, childclass))?);
                    self.read[index].add_body(own);
                }
                "geom" => {
                    if let Some(shape) = shape(self.element(node, childclass), body, pose)? {
                        self.read[index].shapes.push(shape);
                    }
                }
                "body" => {
                    let at = pose.after(self.element(node, childclass).pose()?);
                    let inner = node.attribute("childclass").unwrap_or(childclass);
                    match node.children().find(|child| child.has_tag_name("joint")) {
                        None => self.merge(node, index, at, childclass)?,
                        Some(joint) => {
                            let joint = self.joint(self.element(joint, inner), index, at)?;
                            let below = self.push(node, Some(joint));
                            self.merge(node, below, Transform::IDENTITY, childclass)?;
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn joint(&self, joint: Element, parent: usize, pose: Transform) -> Result<LinkJoint, ImportError> {
        if joint.attribute("type").is_some_and(|kind| kind != "hinge") {
            return Err(attribute_error(joint.node, "type", "hinge"));
        }
        if joint.numbers::<3>("pos", "three numbers")?.is_some_and(|at| vector(at).length() > 1e-9) {
            let problem = "a joint away from the origin of its body is not supported; move the body".to_owned();
            return Err(ImportError::Unsupported { line: line(joint.node), problem });
        }
        let name = joint.attribute("name").ok_or_else(|| attribute_error(joint.node, "name", "a name"))?.to_owned();
        let range = joint
            .numbers::<2>("range", "two angles")?
            .unwrap_or([-180.0, 180.0].map(|a: f64| a.to_radians() / self.angle));
        let of_joint = joint.numbers::<2>("actuatorfrcrange", "two torques")?.map(|[_, high]| high);
        Ok(LinkJoint {
            torque_limit: of_joint.map_or_else(|| self.actuator_limit(&name), |limit| Ok(Some(limit)))?,
            name,
            parent,
            pose,
            axis: vector(joint.numbers("axis", "three numbers")?.unwrap_or([0.0, 0.0, 1.0])),
            range: range.map(|angle| self.angle * angle),
            speed_limit: f64::INFINITY,
            armature: joint.number("armature")?.unwrap_or(0.0),
            damping: joint.number("damping")?.unwrap_or(0.0),
            friction: joint.number("frictionloss")?.unwrap_or(0.0),
        })
    }

    /// Returns the highest torque of the actuator of a joint [N·m].
    fn actuator_limit(&self, joint: &str) -> Result<Option<f64>, ImportError> {
        let Some(node) = self.actuators.iter().find(|node| node.attribute("joint") == Some(joint)) else {
            return Ok(None);
        };
        let actuator = self.element(*node, "main");
        let gear = actuator.number_of_gear()?;
        let force = actuator.numbers::<2>("forcerange", "two torques")?;
        let range = match force {
            None if node.has_tag_name("motor") => actuator.numbers::<2>("ctrlrange", "two torques")?,
            force => force,
        };
        Ok(range.map(|[_, high]| gear * high))
    }
}

impl Element<'_, '_> {
    /// Returns the ratio from the force of an actuator to the torque of its joint.
    fn number_of_gear(&self) -> Result<f64, ImportError> {
        Ok(self.numbers::<6>("gear", "a ratio")?.map_or(1.0, |[gear, ..]| gear))
    }
}

fn mass(inertial: Element) -> Result<RigidBody, ImportError> {
    let mass = inertial.number("mass")?.ok_or_else(|| attribute_error(inertial.node, "mass", "a number"))?;
    let inertia = if let Some([xx, yy, zz, xy, xz, yz]) = inertial.numbers("fullinertia", "six numbers")? {
        DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
    } else if let Some(moments) = inertial.numbers("diaginertia", "three numbers")? {
        DMat3::from_diagonal(vector(moments))
    } else {
        return Err(attribute_error(inertial.node, "diaginertia", "three numbers, or six of `fullinertia`,"));
    };
    Ok(inertial.pose()?.body(RigidBody { mass, com: DVec3::ZERO, inertia }))
}

/// Returns the collision shape of a geom. Returns `None` for a mesh and for a geom that collides with nothing.
fn shape(geom: Element, body: Node, pose: Transform) -> Result<Option<Shape>, ImportError> {
    let flag = |name: &'static str| geom.attribute(name).is_none_or(|value| value != "0");
    if !flag("contype") && !flag("conaffinity") {
        return Ok(None);
    }
    let name = geom.attribute("name").or(body.attribute("name")).unwrap_or("geom").to_owned();
    let size = geom.numbers::<3>("size", "up to three numbers")?;
    let Some(size) = size else { return Ok(None) };
    let (mut local, mut half_length) = (None, size[1]);
    if let Some([ax, ay, az, bx, by, bz]) = geom.numbers("fromto", "six numbers")? {
        let (from, to) = (DVec3::new(ax, ay, az), DVec3::new(bx, by, bz));
        half_length = 0.5 * (to - from).length();
        let rotation = DQuat::from_rotation_arc(DVec3::Z, (to - from).normalize_or(DVec3::Z));
        local = Some(Transform { rotation: DMat3::from_quat(rotation), translation: 0.5 * (from + to) });
    }
    let kind = match geom.attribute("type").unwrap_or("sphere") {
        "box" => ShapeKind::Box(vector(size)),
        "sphere" => ShapeKind::Sphere(size[0]),
        "capsule" | "cylinder" => ShapeKind::Capsule { radius: size[0], half_length },
        _ => return Ok(None),
    };
    let local = local.map_or_else(|| geom.pose(), Ok)?;
    Ok(Some(Shape { name, kind, pose: pose.after(local) }))
}
