//! A robot as the equations see it: the tree, the joints, the feet, and what its sensors add.

use glam::DVec3;
use twinstep_model::{Feet, Foot, JointModel, RobotModel, RobotTree, TreeModel};

use crate::JointScale;

/// Robot with everything that effects change.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Bodies and joints. Its numbers of joints are not used.
    pub tree: RobotTree,
    /// Joints with their actuators.
    pub joints: Vec<JointModel>,
    /// How much stronger the motor of a joint is than a Go2's: the priors of torques scale with it.
    pub scale: Vec<f64>,
    /// Feet.
    pub feet: Vec<Foot>,
    /// The other parts that may touch the ground.
    pub other_parts: Vec<Sphere>,
    /// Exponent n of the supply law `τ (V / V_ref)ⁿ`.
    pub voltage_exponent: f64,
    /// Loss of torque [1/K] above a temperature [°C], by joint.
    pub thermal: Vec<[f64; 2]>,
    /// Reading of the gyroscope at rest [rad/s].
    pub gyro_bias: DVec3,
    /// Friction coefficient of the ground.
    pub ground_friction: f64,
    /// Time constant of the contact with the ground [s].
    pub contact_time: f64,
}

/// Sphere that moves with a body, or a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Index of the body.
    pub body: usize,
    /// Centre in the frame of the body [m].
    pub centre: DVec3,
    /// Radius [m]; zero for a point.
    pub radius: f64,
}

impl From<&Foot> for Sphere {
    fn from(foot: &Foot) -> Self {
        Self { body: foot.body, centre: foot.centre, radius: foot.radius }
    }
}

/// Returns the corners of the boxes of trunk and thighs, and the knees.
fn other_parts(robot: &RobotModel) -> Vec<Sphere> {
    let shapes = &robot.shapes;
    let signs = || [1.0, -1.0].into_iter();
    let corners = |body: usize, centre: DVec3, half: DVec3| {
        let corners = signs().flat_map(|x| signs().flat_map(move |y| signs().map(move |z| DVec3::new(x, y, z))));
        corners.map(move |corner| Sphere { body, centre: centre + corner * half, radius: 0.0 })
    };
    let of_leg = |leg: usize| {
        // The body of a joint follows the base and the bodies of the joints before.
        let knee = Sphere { body: 3 * leg + 3, centre: shapes.calf_ends[0], radius: shapes.calf_radius };
        corners(3 * leg + 2, shapes.thigh_centre, shapes.thigh_half_size).chain([knee])
    };
    corners(0, DVec3::ZERO, shapes.trunk_half_size).chain((0..robot.legs.len()).flat_map(of_leg)).collect()
}

impl Robot {
    /// Returns true if the bodies are known, not the drives alone.
    pub fn has_bodies(&self) -> bool {
        self.tree.bodies.iter().any(|body| body.inertia.mass > 0.0)
    }
}

impl From<&RobotModel> for Robot {
    fn from(robot: &RobotModel) -> Self {
        let mut tree = RobotTree::from(robot);
        tree.joints.iter_mut().for_each(|joint| joint.armature = 0.0);
        let derating = &robot.derating;
        Self {
            tree,
            joints: robot.joints.to_vec(),
            scale: vec![1.0; robot.joints.len()],
            feet: Feet::from(robot).feet().to_vec(),
            other_parts: other_parts(robot),
            voltage_exponent: derating.voltage_exponent,
            thermal: derating
                .per_kelvin
                .into_iter()
                .zip(derating.reference_temperature_c)
                .map(|(a, b)| [a, b])
                .collect(),
            gyro_bias: robot.gyro_bias,
            ground_friction: robot.contact.friction,
            contact_time: robot.contact.time_constant,
        }
    }
}

/// Torque limit of the joints of a Go2 [N·m]: hips and thighs.
const OF_GO2: f64 = 23.7;

impl From<&TreeModel> for Robot {
    /// A robot of any tree, without feet.
    fn from(robot: &TreeModel) -> Self {
        let mut tree = robot.tree.clone();
        tree.joints.iter_mut().for_each(|joint| joint.armature = 0.0);
        Self {
            tree,
            joints: robot.joints.clone(),
            scale: JointScale::of(robot).iter().map(|scale| scale.torque / OF_GO2).collect(),
            feet: Vec::new(),
            other_parts: Vec::new(),
            voltage_exponent: 0.0,
            thermal: vec![[0.0; 2]; robot.joints.len()],
            gyro_bias: DVec3::ZERO,
            ground_friction: robot.contact.friction,
            contact_time: robot.contact.time_constant,
        }
    }
}
