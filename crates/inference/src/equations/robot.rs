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
            voltage_exponent: 0.0,
            thermal: vec![[0.0; 2]; robot.joints.len()],
            gyro_bias: DVec3::ZERO,
            ground_friction: robot.contact.friction,
            contact_time: robot.contact.time_constant,
        }
    }
}
