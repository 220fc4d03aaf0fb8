//! The tree as a MuJoCo model, with the same bodies, joints and shapes.

use std::fmt::Write as _;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use twinstep_model::{
    BaseMount, CONTACT, Contact, FreeJoint, MjcfActuator, RobotTree, TreeJoint, TreeJointKind, TreeShape, TreeShapeKind,
};

/// Settings of the MuJoCo model of a tree.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeMjcf {
    /// Physics step [s].
    pub timestep: f64,
    /// Type of the actuators.
    pub actuator: MjcfActuator,
    /// Joint positions [rad or m] of the keyframe `start`, in which the lowest contact point of a free robot touches the ground; `None`
    /// for no keyframe.
    pub start: Option<Vec<f64>>,
    /// Contact with the ground.
    pub contact: Contact,
}

impl Default for TreeMjcf {
    /// 1 kHz, torque control, no keyframe.
    fn default() -> Self {
        Self { timestep: 0.001, actuator: MjcfActuator::Torque, start: None, contact: CONTACT }
    }
}

/// Returns the MuJoCo model (MJCF, XML) of a robot on flat ground.
///
/// There is an actuator for each joint that has actuators, in the order of the joints. A base with mass of which nothing says that it is
/// fixed moves freely. The contact points are those of the batch engine: spheres, ends of capsules and corners of boxes. There is no
/// self-collision. Contacts and joint limits are as in the batch engine.
pub fn write_mjcf(tree: &RobotTree, options: &TreeMjcf) -> String {
    let mut writer = Writer { tree, actuator: options.actuator, text: String::new() };
    let timestep = options.timestep;
    let name = escaped(&tree.name);
    writer.line(0, &format!("<mujoco model=\"{name}\">"));
    writer.line(1, "<compiler angle=\"radian\" autolimits=\"true\"/>");
    writer
        .line(1, &format!("<option timestep=\"{timestep}\" gravity=\"0 0 -9.81\" cone=\"elliptic\" impratio=\"30\"/>"));
    // The shapes of the robot touch only the ground.
    writer.line(1, "<default>");
    let Contact { friction, time_constant, damping_ratio } = options.contact;
    let contact =
        format!("friction=\"{friction} 0 0\" solref=\"{} {damping_ratio}\"", time_constant.max(2.0 * timestep));
    writer.line(2, &format!("<joint solreflimit=\"{} 1\"/>", 2.0 * timestep));
    writer.line(2, &format!("<geom contype=\"0\" conaffinity=\"1\" condim=\"3\" {contact}/>"));
    writer.line(1, "</default>");
    writer.line(1, "<worldbody>");
    writer.line(2, "<geom type=\"plane\" size=\"0 0 1\" contype=\"1\" conaffinity=\"0\"/>");
    writer.body(0, DVec3::ZERO, 2);
    writer.line(1, "</worldbody>");
    writer.line(1, "<actuator>");
    for joint in tree.joints.iter().filter(|joint| joint.effort.is_some()) {
        writer.motor(joint);
    }
    writer.line(1, "</actuator>");
    if let Some(q) = &options.start {
        writer.keyframe(q);
    }
    writer.line(0, "</mujoco>");
    writer.text
}

struct Writer<'a> {
    tree: &'a RobotTree,
    actuator: MjcfActuator,
    text: String,
}

impl Writer<'_> {
    fn line(&mut self, depth: usize, line: &str) {
        writeln!(self.text, "{:width$}{line}", "", width = 2 * depth).expect("a String takes every text");
    }

    /// Returns true if the base moves freely. One without mass cannot.
    fn is_free(&self) -> bool {
        let default = if self.tree.bodies[0].inertia.mass > 0.0 { BaseMount::Floating } else { BaseMount::Fixed };
        self.tree.base.unwrap_or(default) == BaseMount::Floating
    }

    /// Returns true if the base is the world itself: it never moves, has no mass, and is at the origin.
    fn is_world(&self) -> bool {
        let tree = self.tree;
        !self.is_free() && tree.bodies[0].inertia.mass == 0.0 && tree.world_from_base == DAffine3::IDENTITY
    }

    /// Returns the name of the base, which is that of no joint, because bodies have the names of joints.
    fn base_name(&self) -> String {
        let name = &self.tree.bodies[0].name;
        if self.tree.joint(name).is_some() { format!("{name}_base") } else { name.clone() }
    }

    /// Writes a body and those below it. `offset` is the origin of the parent of the tree in the body that was written for it [m].
    fn body(&mut self, index: usize, offset: DVec3, depth: usize) {
        let joint = index.checked_sub(1).map(|joint| &self.tree.joints[joint]);
        let is_world = index == 0 && self.is_world();
        let inner = depth + usize::from(!is_world);
        if !is_world {
            let pose = joint.map_or(self.tree.world_from_base, |joint| {
                DAffine3::from_translation(offset) * joint.parent_from_child
            });
            // The name of the joint, because a body of the file may be several bodies of the tree.
            let name = joint.map_or_else(|| self.base_name(), |joint| joint.name.clone());
            let name = escaped(&name);
            self.line(depth, &format!("<body name=\"{name}\"{}>", placed(pose)));
        }
        if index == 0 && self.is_free() {
            self.line(inner, &free_joint(&self.tree.free_joint));
        }
        let (mut last, mut at) = (index, DVec3::ZERO);
        if let Some(joint) = joint {
            self.joint(joint, at, inner);
            // MuJoCo has no bodies without mass between joints, but several joints on a body.
            while let Some(next) = self.next_at_same_body(last) {
                let joint = &self.tree.joints[next];
                at += joint.parent_from_child.translation;
                self.joint(joint, at, inner);
                last = next + 1;
            }
        }
        self.contents(last, at, inner);
        if !is_world {
            self.line(depth, "</body>");
        }
    }

    /// Returns the joint below a body that has nothing else, if it can be a joint of the same body.
    fn next_at_same_body(&self, index: usize) -> Option<usize> {
        let mut below = (0..self.tree.joints.len()).filter(|joint| self.tree.joints[*joint].parent == index);
        let (Some(next), None) = (below.next(), below.next()) else { return None };
        let is_empty =
            self.tree.bodies[index].inertia.mass == 0.0 && !self.tree.shapes.iter().any(|shape| shape.body == index);
        (is_empty && self.tree.joints[next].parent_from_child.matrix3 == DMat3::IDENTITY).then_some(next)
    }

    /// Writes mass, shapes and bodies of a body whose origin is at `offset` [m] in the one that is written.
    fn contents(&mut self, index: usize, offset: DVec3, depth: usize) {
        let inertia = self.tree.bodies[index].inertia;
        if inertia.mass > 0.0 {
            let DMat3 { x_axis, y_axis, z_axis } = inertia.inertia;
            let full = numbers(&[x_axis.x, y_axis.y, z_axis.z, y_axis.x, z_axis.x, z_axis.y]);
            let (place, mass) = (numbers(&(offset + inertia.com).to_array()), inertia.mass);
            self.line(depth, &format!("<inertial pos=\"{place}\" mass=\"{mass}\" fullinertia=\"{full}\"/>"));
        }
        for (number, shape) in self.tree.shapes.iter().enumerate().filter(|(_, shape)| shape.body == index) {
            self.shape(number, shape, offset, depth);
        }
        for (child, joint) in self.tree.joints.iter().enumerate() {
            if joint.parent == index {
                self.body(child + 1, offset, depth);
            }
        }
    }

    fn joint(&mut self, joint: &TreeJoint, at: DVec3, depth: usize) {
        let kind = if joint.kind == TreeJointKind::Revolute { "hinge" } else { "slide" };
        let (name, axis) = (escaped(&joint.name), numbers(&joint.axis.to_array()));
        let mut text = format!("<joint name=\"{name}\" type=\"{kind}\" axis=\"{axis}\"");
        if at != DVec3::ZERO {
            write!(text, " pos=\"{}\"", numbers(&at.to_array())).expect("a String takes every text");
        }
        if joint.range.iter().all(|limit| limit.is_finite()) {
            write!(text, " range=\"{}\"", numbers(&joint.range)).expect("a String takes every text");
        }
        let spring = joint.spring;
        let rest = if spring.stiffness == 0.0 { 0.0 } else { spring.torque_offset / spring.stiffness };
        for (name, value) in [
            ("armature", joint.armature),
            ("damping", joint.damping),
            ("frictionloss", joint.friction),
            ("stiffness", spring.stiffness),
            ("springref", rest),
        ] {
            if value != 0.0 {
                write!(text, " {name}=\"{value}\"").expect("a String takes every text");
            }
        }
        self.line(depth, &(text + "/>"));
    }

    fn shape(&mut self, number: usize, shape: &TreeShape, offset: DVec3, depth: usize) {
        let (kind, size) = match shape.kind {
            TreeShapeKind::Box(half) => ("box", half.to_array().to_vec()),
            TreeShapeKind::Sphere(radius) => ("sphere", vec![radius]),
            TreeShapeKind::Ellipsoid(radii) => ("ellipsoid", radii.to_array().to_vec()),
            TreeShapeKind::Capsule { radius, half_length } => ("capsule", vec![radius, half_length]),
            TreeShapeKind::Cylinder { radius, half_length } => ("cylinder", vec![radius, half_length]),
            TreeShapeKind::Mesh(_) => return,
        };
        let (size, place) = (numbers(&size), placed(DAffine3::from_translation(offset) * shape.body_from_shape));
        // Shapes that do not touch the ground in the batch engine do not touch it here.
        let touches = if matches!(kind, "ellipsoid" | "cylinder") { " conaffinity=\"0\"" } else { "" };
        self.line(
            depth,
            &format!("<geom name=\"{}\" type=\"{kind}\" size=\"{size}\"{place}{touches}/>", geom_name(number)),
        );
    }

    fn motor(&mut self, joint: &TreeJoint) {
        let name = escaped(&joint.name);
        let limits =
            joint.effort.filter(|effort| effort.iter().all(|limit| limit.is_finite()) && effort[0] < effort[1]);
        let range = |key: &str| limits.map_or(String::new(), |effort| format!(" {key}=\"{}\"", numbers(&effort)));
        let (kind, parameters) = match self.actuator {
            MjcfActuator::Torque => ("motor", range("ctrlrange")),
            MjcfActuator::Position { kp, kd } => {
                ("position", format!(" kp=\"{kp}\" kv=\"{kd}\"{}", range("forcerange")))
            }
        };
        self.line(2, &format!("<{kind} name=\"{name}\" joint=\"{name}\"{parameters}/>"));
    }

    fn keyframe(&mut self, q: &[f64]) {
        let height = self.tree.standing_height(q);
        let base = if self.is_free() { format!("0 0 {height} 1 0 0 0 ") } else { String::new() };
        self.line(1, "<keyframe>");
        self.line(2, &format!("<key name=\"start\" qpos=\"{base}{}\"/>", numbers(q)));
        self.line(1, "</keyframe>");
    }
}

/// Returns the name of the geom of shape `number` of the tree.
pub fn geom_name(number: usize) -> String {
    format!("shape{number}")
}

/// Returns the attributes of a pose.
fn placed(pose: DAffine3) -> String {
    let mut text = String::new();
    if pose.translation != DVec3::ZERO {
        write!(text, " pos=\"{}\"", numbers(&pose.translation.to_array())).expect("a String takes every text");
    }
    if pose.matrix3 != DMat3::IDENTITY {
        let rotation = DQuat::from_mat3(&pose.matrix3);
        let quaternion = numbers(&[rotation.w, rotation.x, rotation.y, rotation.z]);
        write!(text, " quat=\"{quaternion}\"").expect("a String takes every text");
    }
    text
}

fn numbers(values: &[f64]) -> String {
    // `to_string` writes the shortest decimals that parse to the same numbers.
    values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

fn free_joint(joint: &FreeJoint) -> String {
    let FreeJoint { armature, damping, friction } = joint;
    if *joint == FreeJoint::default() {
        return "<freejoint/>".to_owned();
    }
    format!("<joint type=\"free\" armature=\"{armature}\" damping=\"{damping}\" frictionloss=\"{friction}\"/>")
}
