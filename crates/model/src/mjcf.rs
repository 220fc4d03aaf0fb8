//! Export of the robot as a MuJoCo model with the same tree, parameters and contacts, for comparison of the physics.

use std::fmt::Write as _;

use glam::{DMat3, DQuat, DVec3, Vec3};

use crate::kinematics::FIXED_BASE_HEIGHT;
use crate::{
    ActuatorParams, BaseMount, Ground, HeightField, InitialState, Joint, JointKind, JointModel, Leg, RigidBody,
    RobotModel,
};

/// Gravity of the model [m/s²].
const GRAVITY: f64 = 9.81;
/// Thickness of a height field below its lowest point [m].
const FIELD_BASE: f64 = 0.5;
/// Width and thickness of the level slabs around a height field [m].
const SURROUNDINGS: [f64; 2] = [500.0, 1.0];

/// Options of a MuJoCo model.
#[derive(Clone, Debug, PartialEq)]
pub struct MjcfOptions {
    /// Mount of the base.
    pub base: BaseMount,
    /// Stand that holds a fixed base; `None` for a rigid one.
    pub stand: Option<CompliantStand>,
    /// Physics step [s].
    pub timestep: f64,
    /// Type of the twelve actuators, which determines the meaning of `ctrl`.
    pub actuator: MjcfActuator,
    /// The ground. Around a height field it is level at z = 0, where the field's edge is expected.
    pub ground: Ground,
}

impl Default for MjcfOptions {
    /// Floating base, torque control, 1 kHz, level ground.
    fn default() -> Self {
        Self {
            base: BaseMount::Floating,
            stand: None,
            timestep: 0.001,
            actuator: MjcfActuator::Torque,
            ground: Ground::FLAT,
        }
    }
}

/// Stand that gives way: the base swings about its place, along and about all axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CompliantStand {
    /// Natural frequency [Hz].
    pub frequency_hz: f64,
    /// Damping ratio.
    pub damping_ratio: f64,
}

/// Type of the actuators of a MuJoCo model, which are in the order of [`Joint::ALL`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MjcfActuator {
    /// `ctrl` is the torque of the current sensor [N·m], clipped to the joint's limit. The gain of the torque acts as a
    /// gear.
    Torque,
    /// `ctrl` is the commanded position [rad]. PD control at every physics step, clipped to the joint's torque limit.
    Position {
        /// Position gain [N·m/rad].
        kp: f64,
        /// Velocity gain [N·m·s/rad].
        kd: f64,
    },
}

/// Returns the MuJoCo model (MJCF, XML) of `robot` on the ground of `options`.
///
/// The trunk is named `trunk`, and each link has the name of its joint. The contact points are those of the batch
/// engine: a sphere at the foot, a sphere at each end of the calf's capsule, and the corners of the trunk's box. There
/// is no self-collision. Contacts have MuJoCo's default impedance and the time constant of [`RobotModel::contact`].
/// Joint limits are as stiff as the time step allows. The keyframe `default_pose` has the robot standing in the default
/// pose, or at [`FIXED_BASE_HEIGHT`] if its base is fixed.
pub fn mjcf(robot: &RobotModel, options: &MjcfOptions) -> String {
    let mut xml = Xml::default();
    xml.open("mujoco", &[("model", robot.name.clone())]);
    xml.leaf("compiler", &[("angle", "radian".to_owned()), ("autolimits", "true".to_owned())]);
    let gravity = numbers([0.0, 0.0, -GRAVITY]);
    xml.leaf(
        "option",
        &[
            ("timestep", options.timestep.to_string()),
            ("gravity", gravity),
            ("integrator", "Euler".to_owned()),
            ("cone", "elliptic".to_owned()),
            ("impratio", "30".to_owned()),
        ],
    );
    defaults(&mut xml, robot, options.timestep);
    let height = base_height(robot, options.base);
    if let Some(field) = &options.ground.height_field {
        height_field(&mut xml, field);
    }
    xml.open("worldbody", &[]);
    xml.leaf("light", &[("pos", numbers([0.0, 0.0, 3.0])), ("directional", "true".to_owned())]);
    ground(&mut xml, &options.ground);
    let moves = options.base == BaseMount::Floating || options.stand.is_some();
    trunk(&mut xml, robot, moves, height);
    xml.close("worldbody");
    if let Some(stand) = options.stand.filter(|_| options.base.is_fixed()) {
        compliant_stand(&mut xml, stand);
    }
    actuators(&mut xml, robot, options.actuator);
    keyframe(&mut xml, robot, moves, height);
    xml.close("mujoco");
    xml.text
}

/// Adds the heights. MuJoCo stretches them to the range 0 to 1, and reads the row with the largest y first.
fn height_field(xml: &mut Xml, field: &HeightField) {
    let ([rows, columns], [low, high]) = (field.shape(), height_range(field));
    let size = |count: usize| 0.5 * f64::from(field.cell_size()) * (count - 1) as f64;
    let row = |column: usize| (0..rows).map(move |row| f64::from(field.heights()[row * columns + column]));
    xml.open("asset", &[]);
    xml.leaf(
        "hfield",
        &[
            ("name", "heights".to_owned()),
            ("nrow", columns.to_string()),
            ("ncol", rows.to_string()),
            ("size", numbers([size(rows), size(columns), (high - low).max(1e-6), FIELD_BASE])),
            ("elevation", numbers((0..columns).rev().flat_map(row))),
        ],
    );
    xml.close("asset");
}

/// Returns the lowest and the highest height [m].
fn height_range(field: &HeightField) -> [f64; 2] {
    let heights = field.heights().iter().map(|height| f64::from(*height));
    heights.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], height| [low.min(height), high.max(height)])
}

fn ground(xml: &mut Xml, ground: &Ground) {
    let collides = [("contype", "1".to_owned()), ("conaffinity", "0".to_owned())];
    let point = Vec3::from(ground.point).as_dvec3();
    if let Some(field) = &ground.height_field {
        let half = |axis: usize| 0.5 * f64::from(field.cell_size()) * (field.shape()[axis] - 1) as f64;
        let centre = |axis: usize| f64::from(field.origin()[axis]) + half(axis);
        let place = numbers([centre(0), centre(1), height_range(field)[0]]);
        let named = [("name", "heights".to_owned()), ("type", "hfield".to_owned()), ("hfield", "heights".to_owned())];
        xml.leaf("geom", &named.into_iter().chain([("pos", place)]).chain(collides.clone()).collect::<Vec<_>>());
        // A plane would fill the pits of the field.
        let [width, thickness] = SURROUNDINGS.map(|size| 0.5 * size);
        let beside = [half(0) + width, half(1) + width];
        for (sign_x, sign_y) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let size = if sign_y == 0.0 { [width, half(1)] } else { [half(0) + 2.0 * width, width] };
            let place = [centre(0) + sign_x * beside[0], centre(1) + sign_y * beside[1], -thickness];
            let slab =
                [("type", "box".to_owned()), ("size", numbers([size[0], size[1], thickness])), ("pos", numbers(place))];
            xml.leaf("geom", &slab.into_iter().chain(collides.clone()).collect::<Vec<_>>());
        }
        return;
    }
    let size = ("size", numbers([0.0, 0.0, 0.05]));
    let mut plane = vec![("name", "ground".to_owned()), ("type", "plane".to_owned()), size];
    if point != DVec3::ZERO {
        plane.push(("pos", numbers(point.to_array())));
    }
    let rotation = DQuat::from_rotation_arc(DVec3::Z, Vec3::from(ground.normal).as_dvec3().normalize());
    if rotation != DQuat::IDENTITY {
        plane.push(("quat", numbers([rotation.w, rotation.x, rotation.y, rotation.z])));
    }
    xml.leaf("geom", &plane.into_iter().chain(collides).collect::<Vec<_>>());
}

fn base_height(robot: &RobotModel, base: BaseMount) -> f64 {
    match base {
        BaseMount::Floating => {
            let standing = InitialState::standing_on(&Ground::FLAT, robot, robot.control.default_pose_f32(), 0.0);
            f64::from(standing.base_position[2])
        }
        BaseMount::Fixed => FIXED_BASE_HEIGHT,
    }
}

fn defaults(xml: &mut Xml, robot: &RobotModel, timestep: f64) {
    let contact = &robot.contact;
    xml.open("default", &[]);
    // MuJoCo's default solimp, as in the batch engine. `refsafe` requires a time constant of at least two steps.
    xml.leaf("joint", &[("limited", "true".to_owned()), ("solreflimit", numbers([2.0 * timestep, 1.0]))]);
    xml.leaf(
        "geom",
        &[
            // Only robot and ground collide.
            ("contype", "0".to_owned()),
            ("conaffinity", "1".to_owned()),
            ("condim", "3".to_owned()),
            ("friction", numbers([contact.friction, 0.0, 0.0])),
            ("solref", numbers([contact.time_constant, contact.damping_ratio])),
            ("solimp", numbers([0.9, 0.95, 0.001])),
        ],
    );
    xml.close("default");
}

/// Adds a soft weld, which holds the base where the model has it.
fn compliant_stand(xml: &mut Xml, stand: CompliantStand) {
    // MuJoCo's time constant of a spring with natural frequency ω and damping ratio ζ is 1 / (ω ζ).
    let time_constant = 1.0 / (std::f64::consts::TAU * stand.frequency_hz * stand.damping_ratio);
    let solref = numbers([time_constant, stand.damping_ratio]);
    xml.open("equality", &[]);
    xml.leaf("weld", &[("name", "stand".to_owned()), ("body1", "trunk".to_owned()), ("solref", solref)]);
    xml.close("equality");
}

fn trunk(xml: &mut Xml, robot: &RobotModel, moves: bool, height: f64) {
    xml.open("body", &[("name", "trunk".to_owned()), ("pos", numbers([0.0, 0.0, height]))]);
    if moves {
        xml.leaf("freejoint", &[("name", "base".to_owned())]);
    }
    inertial(xml, &robot.trunk);
    let size = numbers(robot.shapes.trunk_half_size.to_array());
    xml.leaf("geom", &[("name", "trunk".to_owned()), ("type", "box".to_owned()), ("size", size)]);
    for leg in Leg::ALL {
        for kind in JointKind::ALL {
            link(xml, robot, Joint { leg, kind });
        }
        calf_geoms(xml, robot, leg);
        for _ in JointKind::ALL {
            xml.close("body");
        }
    }
    xml.close("body");
}

/// Opens the child link of `joint`.
fn link(xml: &mut Xml, robot: &RobotModel, joint: Joint) {
    let (leg, numbers_of) = (&robot.legs[joint.leg as usize], &robot.joints[joint.index()]);
    let origin = leg.origins[joint.kind as usize];
    xml.open("body", &[("name", joint.name().to_owned()), ("pos", numbers(origin.to_array()))]);
    inertial(xml, &leg.bodies[joint.kind as usize]);
    let is_hip = joint.kind as usize == 0;
    if is_hip {
        sphere(xml, joint.leg, "motors", robot.hip_centre(joint.leg as usize), robot.shapes.hip_radius);
    }
    let has_limits = numbers_of.range.iter().all(|limit| limit.is_finite());
    let mut attributes = vec![
        ("name", joint.name().to_owned()),
        ("axis", numbers(RobotModel::axis(joint).to_array())),
        if has_limits { ("range", numbers(numbers_of.range)) } else { ("limited", "false".to_owned()) },
        ("armature", numbers_of.armature.to_string()),
    ];
    let JointModel { viscous_friction, coulomb_friction, spring, .. } = numbers_of;
    let forces = [
        ("damping", *viscous_friction),
        ("frictionloss", *coulomb_friction),
        ("stiffness", spring.stiffness),
        ("springref", if spring.stiffness > 0.0 { spring.torque_offset / spring.stiffness } else { 0.0 }),
    ];
    attributes
        .extend(forces.into_iter().filter(|(_, value)| *value != 0.0).map(|(name, value)| (name, value.to_string())));
    xml.leaf("joint", &attributes);
}

fn calf_geoms(xml: &mut Xml, robot: &RobotModel, leg: Leg) {
    let shapes = &robot.shapes;
    let spheres = [
        ("foot", shapes.foot_centre, shapes.foot_radius),
        ("shin", shapes.calf_ends[1], shapes.calf_radius),
        ("knee", shapes.calf_ends[0], shapes.calf_radius),
    ];
    for (part, centre, radius) in spheres {
        sphere(xml, leg, part, centre, radius);
    }
}

fn sphere(xml: &mut Xml, leg: Leg, part: &str, centre: DVec3, radius: f64) {
    let name = format!("{}_{part}", leg.name());
    let place = numbers(centre.to_array());
    xml.leaf("geom", &[("name", name), ("type", "sphere".to_owned()), ("pos", place), ("size", radius.to_string())]);
}

fn inertial(xml: &mut Xml, body: &RigidBody) {
    let RigidBody { mass, com, inertia } = *body;
    let DMat3 { x_axis, y_axis, z_axis } = inertia;
    let full = [x_axis.x, y_axis.y, z_axis.z, y_axis.x, z_axis.x, z_axis.y];
    let (place, mass) = (numbers(DVec3::to_array(&com)), mass.to_string());
    xml.leaf("inertial", &[("pos", place), ("mass", mass), ("fullinertia", numbers(full))]);
}

fn actuators(xml: &mut Xml, robot: &RobotModel, actuator: MjcfActuator) {
    xml.open("actuator", &[]);
    for joint in Joint::ALL {
        let JointModel { torque_limit: limit, actuator: ActuatorParams { gain, .. }, .. } = robot.joints[joint.index()];
        let name = joint.name().to_owned();
        let (named, range) = ([("name", name.clone()), ("joint", name)], numbers([-limit, limit]));
        match actuator {
            MjcfActuator::Torque => {
                let gear = (gain != 1.0).then(|| ("gear", gain.to_string()));
                xml.leaf("motor", &named.into_iter().chain([("ctrlrange", range)]).chain(gear).collect::<Vec<_>>());
            }
            MjcfActuator::Position { kp, kd } => {
                let gains = [("kp", kp.to_string()), ("kv", kd.to_string()), ("forcerange", range)];
                xml.leaf("position", &[&named[..], &gains].concat());
            }
        }
    }
    xml.close("actuator");
}

fn keyframe(xml: &mut Xml, robot: &RobotModel, moves: bool, height: f64) {
    let free = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0];
    let free = if moves { &free[..] } else { &[] };
    let qpos = numbers(free.iter().copied().chain(robot.control.default_pose));
    xml.open("keyframe", &[]);
    xml.leaf("key", &[("name", "default_pose".to_owned()), ("qpos", qpos)]);
    xml.close("keyframe");
}

fn numbers(values: impl IntoIterator<Item = f64>) -> String {
    // `to_string` writes the shortest decimals that parse to the same numbers.
    values.into_iter().map(|value| value.to_string()).collect::<Vec<_>>().join(" ")
}

/// XML writer, one element per line, indented by depth.
#[derive(Default)]
struct Xml {
    text: String,
    depth: usize,
}

impl Xml {
    fn open(&mut self, name: &str, attributes: &[(&str, String)]) {
        self.element(name, attributes, ">");
        self.depth += 1;
    }

    fn leaf(&mut self, name: &str, attributes: &[(&str, String)]) {
        self.element(name, attributes, "/>");
    }

    fn close(&mut self, name: &str) {
        self.depth -= 1;
        writeln!(self.text, "{:width$}</{name}>", "", width = 2 * self.depth).expect("a String takes every text");
    }

    fn element(&mut self, name: &str, attributes: &[(&str, String)], end: &str) {
        write!(self.text, "{:width$}<{name}", "", width = 2 * self.depth).expect("a String takes every text");
        for (key, value) in attributes {
            write!(self.text, " {key}=\"{}\"", escaped(value)).expect("a String takes every text");
        }
        self.text.push_str(end);
        self.text.push('\n');
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NUM_JOINTS, go2};

    /// Returns the values of `attribute` in all elements named `element`.
    fn values<'a>(xml: &'a str, element: &str, attribute: &str) -> Vec<&'a str> {
        let key = format!(" {attribute}=\"");
        xml.lines()
            .filter(|line| line.trim_start().starts_with(&format!("<{element} ")))
            .filter_map(|line| line.split_once(&key)?.1.split('"').next())
            .collect()
    }

    fn model(options: MjcfOptions) -> String {
        mjcf(&go2(), &options)
    }

    #[test]
    fn elements_are_closed_in_reverse_order() {
        let mut robot = go2();
        robot.name = "a \"b\" <c> & d".to_owned();
        let xml = mjcf(&robot, &MjcfOptions::default());
        let mut open = Vec::new();
        for line in xml.lines().map(str::trim) {
            assert!(line.starts_with('<') && line.ends_with('>') && line.matches('<').count() == 1, "{line}");
            let name = line.trim_start_matches(['<', '/']).split([' ', '>', '/']).next().expect("a name");
            match line {
                _ if line.starts_with("</") => assert_eq!(open.pop(), Some(name)),
                _ if line.ends_with("/>") => {}
                _ => open.push(name),
            }
        }
        assert!(open.is_empty());
        assert!(xml.starts_with("<mujoco model=\"a &quot;b&quot; &lt;c> &amp; d\">"));
    }

    #[test]
    fn numbers_of_bodies_joints_and_geoms_agree_with_the_robot() {
        let xml = model(MjcfOptions::default());
        assert_eq!(values(&xml, "body", "name").len(), 1 + NUM_JOINTS);
        assert_eq!(values(&xml, "joint", "name"), crate::JOINT_NAMES);
        assert_eq!(values(&xml, "motor", "joint"), crate::JOINT_NAMES);
        assert_eq!(
            values(&xml, "geom", "name").len(),
            2 + 16,
            "ground and trunk; hip, foot, shin and knee of each leg"
        );
    }

    #[test]
    fn total_mass_agrees_with_the_robot() {
        let xml = model(MjcfOptions::default());
        let mass: f64 =
            values(&xml, "inertial", "mass").into_iter().map(|mass| mass.parse::<f64>().expect("a number")).sum();
        assert!((mass - go2().total_mass()).abs() < 1e-12);
    }

    #[test]
    fn heights_have_their_range_as_size_and_the_largest_y_first() {
        // Three rows along x, two columns along y.
        let heights = vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6];
        let field = HeightField::new([1.0, 2.0], 0.5, [3, 2], heights).expect("valid");
        let ground = Ground { height_field: Some(field.into()), ..Ground::FLAT };
        let xml = model(MjcfOptions { ground, ..MjcfOptions::default() });
        let rounded = |attribute: &str| {
            let numbers = values(&xml, "hfield", attribute)[0].split(' ').map(str::parse::<f64>);
            numbers.map(|number| (1e6 * number.expect("a number")).round() / 1e6).collect::<Vec<_>>()
        };
        assert_eq!((values(&xml, "hfield", "nrow"), values(&xml, "hfield", "ncol")), (vec!["2"], vec!["3"]));
        assert_eq!(rounded("size"), [0.5, 0.25, 0.5, FIELD_BASE]);
        assert_eq!(rounded("elevation"), [0.2, 0.4, 0.6, 0.1, 0.3, 0.5]);
        let places: Vec<_> = values(&xml, "geom", "pos")[0].split(' ').collect();
        assert_eq!((places[0], places[1]), ("1.5", "2.25"));
        assert!(!values(&xml, "geom", "type").contains(&"plane"), "a plane would fill the pits");
        let slabs = values(&xml, "geom", "type").iter().filter(|kind| **kind == "box").count();
        let without = model(MjcfOptions::default());
        assert_eq!(slabs, 4 + values(&without, "geom", "type").iter().filter(|kind| **kind == "box").count());
    }

    #[test]
    fn fixed_base_has_no_free_joint() {
        let [floating, fixed] =
            [BaseMount::Floating, BaseMount::Fixed].map(|base| model(MjcfOptions { base, ..MjcfOptions::default() }));
        assert_eq!(floating.matches("<freejoint").count(), 1);
        assert_eq!(fixed.matches("<freejoint").count(), 0);
        let positions = |xml: &str| values(xml, "key", "qpos")[0].split(' ').count();
        assert_eq!((positions(&floating), positions(&fixed)), (7 + NUM_JOINTS, NUM_JOINTS));
    }

    #[test]
    fn compliant_stand_holds_a_free_base_by_a_soft_weld() {
        let stand = Some(CompliantStand { frequency_hz: 10.0, damping_ratio: 0.2 });
        let xml = model(MjcfOptions { base: BaseMount::Fixed, stand, ..MjcfOptions::default() });
        assert_eq!((xml.matches("<freejoint").count(), xml.matches("<weld").count()), (1, 1));
        let solref: Vec<f64> =
            values(&xml, "weld", "solref")[0].split(' ').map(|number| number.parse().expect("a number")).collect();
        assert!((solref[0] - 0.0796).abs() < 1e-4 && solref[1] == 0.2, "{solref:?}");
        let floating = model(MjcfOptions { stand, ..MjcfOptions::default() });
        assert_eq!(floating.matches("<weld").count(), 0, "a floating base has no stand");
    }

    #[test]
    fn spring_and_torque_gain_are_exported() {
        let mut robot = go2();
        robot.joints[2].spring = crate::JointSpring { stiffness: 2.0, torque_offset: -3.0 };
        robot.joints[2].actuator.gain = 0.9;
        let xml = mjcf(&robot, &MjcfOptions::default());
        assert_eq!((values(&xml, "joint", "stiffness"), values(&xml, "joint", "springref")), (vec!["2"], vec!["-1.5"]));
        assert_eq!(values(&xml, "motor", "gear"), ["0.9"]);
    }

    #[test]
    fn position_actuator_has_the_gains_and_the_torque_limit() {
        let actuator = MjcfActuator::Position { kp: 40.0, kd: 1.0 };
        let xml = model(MjcfOptions { actuator, ..MjcfOptions::default() });
        assert_eq!(values(&xml, "position", "kp"), ["40"; NUM_JOINTS]);
        assert_eq!(values(&xml, "position", "kv"), ["1"; NUM_JOINTS]);
        assert_eq!(values(&xml, "position", "forcerange")[2], "-45.43 45.43");
    }
}
