//! What a page shows, and its bytes.

use bytes::{BufMut, Bytes, BytesMut};
use serde::{Deserialize, Serialize};
use twinstep_model::{Ground, JOINT_NAMES, Leg, RobotModel, RobotTree, Scene, SceneShape, TreeShape};

/// What stays the same while a page is open.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneInfo {
    /// Heading of the page.
    pub title: String,
    /// Names of the bodies.
    pub bodies: Vec<String>,
    /// Shapes of the bodies.
    pub shapes: Vec<SceneShape>,
    /// Heights of the ground; `None` for level ground at z = 0.
    pub heights: Option<Heights>,
    /// Names of the joints; joint `i` moves body `i + 1`.
    pub joints: Vec<String>,
    /// Largest torque of each joint [N·m], or force [N], for its colour; `None` if the robot's file has none.
    pub torque_limits: Vec<Option<f32>>,
    /// Where the ground may push the robot, in the order of [`RobotFrame::contact_force`].
    pub contacts: Vec<Contact>,
    /// Names of the curves that each robot has: torque, height, uncertainty of its actuators, reward terms.
    #[serde(default)]
    pub robot_curves: Vec<String>,
    /// True if every robot has a second pose, that of a simulation under the same commands.
    pub has_ghost: bool,
    /// True if the page may pause, change the speed and, with a velocity command, push the robots and begin a new episode.
    pub is_interactive: bool,
    /// True if the page has the learning curve of the policy.
    #[serde(default)]
    pub is_learning: bool,
    /// Bounds of the velocity command of the page: forward [m/s], left [m/s], yaw rate [rad/s]. `None` if it has none.
    pub velocity_bounds: Option<[[f32; 2]; 3]>,
}

/// Point of a body at which the ground pushes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Contact {
    /// Name.
    pub name: String,
    /// Index of its body.
    pub body: usize,
    /// Position in the frame of the body [m].
    pub position: [f32; 3],
}

/// Heights of the ground on a regular grid.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Heights {
    /// Position of the first point [m].
    pub origin: [f32; 2],
    /// Distance of neighbouring points [m].
    pub cell_size: f32,
    /// Number of points along x and along y.
    pub shape: [usize; 2],
    /// Heights [m], y fastest.
    pub heights: Vec<f32>,
}

impl SceneInfo {
    /// Returns the description of a scene of a robot like the Go2, without controls.
    pub fn new(title: impl Into<String>, scene: &Scene, robot: &RobotModel) -> Self {
        let position = robot.shapes.foot_centre.as_vec3().to_array();
        let foot = |leg: Leg| Contact { name: leg.name().to_owned(), body: 3 + 3 * leg as usize, position };
        Self {
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            torque_limits: robot.torque_limits().map(Some).to_vec(),
            contacts: Leg::ALL.map(foot).to_vec(),
            ..Self::without_joints(title, scene)
        }
    }

    /// Returns the description of a scene of any robot, without controls.
    pub fn of_tree(title: impl Into<String>, scene: &Scene, tree: &RobotTree) -> Self {
        let limit = |[low, high]: [f64; 2]| low.abs().max(high.abs()) as f32;
        let contact = |(index, shape): (usize, &TreeShape)| Contact {
            name: format!("{}_{index}", tree.bodies[shape.body].name),
            body: shape.body,
            position: shape.body_from_shape.translation.as_vec3().to_array(),
        };
        Self {
            joints: tree.joints.iter().map(|joint| joint.name.clone()).collect(),
            torque_limits: tree.joints.iter().map(|joint| joint.effort.map(limit)).collect(),
            contacts: tree.shapes.iter().enumerate().map(contact).collect(),
            ..Self::without_joints(title, scene)
        }
    }

    fn without_joints(title: impl Into<String>, scene: &Scene) -> Self {
        Self {
            title: title.into(),
            bodies: scene.bodies.clone(),
            shapes: scene.shapes.clone(),
            heights: heights(&scene.ground),
            joints: Vec::new(),
            torque_limits: Vec::new(),
            contacts: Vec::new(),
            robot_curves: Vec::new(),
            has_ghost: false,
            is_interactive: false,
            is_learning: false,
            velocity_bounds: None,
        }
    }

    /// Returns the description of a scene on this ground, which all robots share.
    pub fn with_ground(self, ground: &Ground) -> Self {
        Self { heights: heights(ground), ..self }
    }

    /// Returns the description of a scene of robots with these reward terms.
    pub fn with_reward_terms(self, names: &[String]) -> Self {
        let quantities = QUANTITIES.iter().map(ToString::to_string);
        let terms = names.iter().map(|name| format!("reward {name}"));
        Self { robot_curves: quantities.chain(terms).collect(), ..self }
    }
}

/// Curves of a robot before its reward terms.
const QUANTITIES: [&str; 3] = ["largest torque [N·m]", "height of the trunk [m]", "uncertainty [nat]"];

/// Returns the values of the curves of the robot of a scene; none if its reward terms are not known.
fn robot_curves(scene: &Scene) -> Vec<f32> {
    if scene.reward_terms.is_empty() {
        return Vec::new();
    }
    let torque = scene.torque.as_ref().map(|torque| torque.iter().fold(0.0_f32, |largest, tau| largest.max(tau.abs())));
    let height = scene.pose.first().map(|trunk| trunk[2]);
    let quantities: [_; QUANTITIES.len()] = [torque, height, scene.uncertainty];
    let quantities = quantities.map(|value| value.unwrap_or(f32::NAN));
    quantities.into_iter().chain(scene.reward_terms.iter().copied()).collect()
}

fn heights(ground: &Ground) -> Option<Heights> {
    let field = ground.height_field.as_ref()?;
    Some(Heights {
        origin: field.origin(),
        cell_size: field.cell_size(),
        shape: field.shape(),
        heights: field.heights().to_vec(),
    })
}

/// One robot at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotFrame {
    /// Pose world-from-body of each body: position [m], quaternion w, x, y, z.
    pub poses: Vec<[f32; 7]>,
    /// The same of the simulation, if the scene has ghosts.
    pub ghost: Vec<[f32; 7]>,
    /// Torque of each joint [N·m]; `None` if it is not known.
    pub torque: Option<Vec<f32>>,
    /// Normal force at each of [`SceneInfo::contacts`] [N]; `None` if it is not known.
    pub contact_force: Option<Vec<f32>>,
    /// Commanded velocity in the base frame: forward [m/s], left [m/s], yaw rate [rad/s].
    pub command: Option<[f32; 3]>,
    /// Velocity in the base frame: forward [m/s], left [m/s], yaw rate [rad/s].
    pub velocity: Option<[f32; 3]>,
    /// Values of [`SceneInfo::robot_curves`].
    pub curves: Vec<f32>,
}

impl RobotFrame {
    /// Returns the robot of a scene.
    pub fn of_scene(scene: &Scene) -> Self {
        Self {
            poses: scene.pose.clone(),
            ghost: Vec::new(),
            torque: scene.torque.clone(),
            contact_force: scene.contact_force.clone(),
            command: scene.command,
            velocity: scene.velocity,
            curves: robot_curves(scene),
        }
    }
}

/// Where a playback is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Playback {
    /// Length of what is played [s]; `None` for a simulation that goes on.
    pub duration: Option<f64>,
    /// True while it stands still.
    pub is_paused: bool,
    /// Speed, 1 for real time.
    pub speed: f64,
}

/// A policy that learns, after one iteration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LearningPoint {
    /// Number of environment steps so far.
    pub env_steps: u64,
    /// Mean reward per step.
    pub reward: f64,
    /// Falls per robot and minute of simulated time [1/min].
    pub falls_per_minute: f64,
    /// Root mean square error of the horizontal velocity [m/s]; `None` if it is not observed.
    pub velocity_error: Option<f64>,
}

/// All robots at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Time [s].
    pub time: f64,
    /// The robots, equally many in every frame.
    pub robots: Vec<RobotFrame>,
    /// Values of the curves beside the scene, by name.
    pub curves: Vec<(String, f64)>,
    /// Playback; `None` if the page has no influence.
    pub playback: Option<Playback>,
}

#[derive(Serialize)]
struct Header<'a> {
    time: f64,
    robots: usize,
    /// Number of torques and of contact forces of each robot.
    joints: usize,
    contacts: usize,
    curves: std::collections::BTreeMap<&'a str, f64>,
    playback: Option<Playback>,
}

impl Frame {
    /// Returns the bytes of the frame: its length and that of its header (u32 each), the header as JSON, padding to a multiple
    /// of four, then numbers (f32): for every robot the poses, the ghost's poses, as many torques and contact forces as the header
    /// says, 3 + 3 velocities, and the robot's curves.
    /// All little-endian; a number that is not known is NaN.
    pub fn to_bytes(&self) -> Bytes {
        let curves = self.curves.iter().map(|(name, value)| (name.as_str(), *value)).collect();
        let most = |values: fn(&RobotFrame) -> &Option<Vec<f32>>| {
            self.robots.iter().filter_map(|robot| values(robot).as_ref().map(Vec::len)).max().unwrap_or(0)
        };
        let (joints, contacts) = (most(|robot| &robot.torque), most(|robot| &robot.contact_force));
        let header =
            Header { time: self.time, robots: self.robots.len(), joints, contacts, curves, playback: self.playback };
        // Numbers and names are always JSON.
        let mut header = serde_json::to_vec(&header).unwrap_or_default();
        header.resize(header.len().next_multiple_of(4), b' ');
        let mut numbers = Vec::new();
        for robot in &self.robots {
            numbers.extend(robot.poses.iter().chain(&robot.ghost).flatten().copied());
            for (values, count) in [(&robot.torque, joints), (&robot.contact_force, contacts)] {
                let known = values.iter().flatten().copied();
                numbers.extend(known.chain(std::iter::repeat(f32::NAN)).take(count));
            }
            numbers.extend(robot.command.unwrap_or([f32::NAN; 3]));
            numbers.extend(robot.velocity.unwrap_or([f32::NAN; 3]));
            numbers.extend(&robot.curves);
        }
        let mut bytes = BytesMut::with_capacity(8 + header.len() + 4 * numbers.len());
        bytes.put_u32_le((header.len() + 4 * numbers.len()) as u32);
        bytes.put_u32_le(header.len() as u32);
        bytes.put_slice(&header);
        for number in numbers {
            bytes.put_f32_le(number);
        }
        bytes.freeze()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_have_lengths_header_and_numbers() {
        let robot = RobotFrame { poses: vec![[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]; 2], ..RobotFrame::default() };
        let robot = RobotFrame {
            torque: Some(vec![7.0; 9]),
            contact_force: Some(vec![1.0, f32::NAN]),
            curves: vec![0.25, 0.5],
            ..robot
        };
        let frame = Frame { time: 0.5, robots: vec![robot.clone(), robot], ..Frame::default() };
        let bytes = frame.to_bytes();
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let (all, header) = (word(0) as usize, word(4) as usize);
        assert_eq!(bytes.len(), 8 + all);
        let text: serde_json::Value = serde_json::from_slice(&bytes[8..8 + header]).expect("JSON");
        assert_eq!((&text["time"], &text["robots"]), (&0.5.into(), &2.into()));
        assert_eq!((&text["joints"], &text["contacts"]), (&9.into(), &2.into()));
        // Two bodies with seven numbers, torques, forces, two velocities, two curves.
        assert_eq!(all - header, 2 * 4 * (14 + 9 + 2 + 6 + 2));
        let number = |index: usize| f32::from_bits(word(8 + header + 4 * index));
        assert_eq!((number(0), number(2), number(14), number(23)), (1.0, 3.0, 7.0, 1.0));
        assert!(number(24).is_nan(), "a force that is not known");
        assert_eq!((number(31), number(32), number(33)), (0.25, 0.5, 1.0));
    }
}
