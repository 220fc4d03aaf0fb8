//! A robot of which only the drives are known.

use glam::{DAffine3, DMat3, DVec3};
use twinstep_model::{FreeJoint, JointSpring, RigidBody, RobotTree, TreeBody, TreeJoint, TreeModel};

use super::tree::TreeModelFile;

impl TreeModelFile {
    /// Returns ideal drives with the names of their joints and the largest torque of each [N·m]: a robot whose bodies are not known.
    pub fn of_drives(joints: &[(String, f64)]) -> Self {
        let massless = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };
        let body = |name: &str| TreeBody { name: name.to_owned(), inertia: massless };
        let hinge = Self::go2().nominal.tree.joints[0].clone();
        let joint = |(name, torque): &(String, f64)| TreeJoint {
            name: name.clone(),
            parent: 0,
            parent_from_child: DAffine3::IDENTITY,
            axis: DVec3::Z,
            range: [f64::NEG_INFINITY, f64::INFINITY],
            effort: Some([-torque, *torque]),
            speed_limit: f64::INFINITY,
            armature: 0.0,
            damping: 0.0,
            friction: 0.0,
            spring: JointSpring { stiffness: 0.0, torque_offset: 0.0 },
            ..hinge.clone()
        };
        let tree = RobotTree {
            name: "drives".to_owned(),
            base: None,
            free_joint: FreeJoint::default(),
            world_from_base: DAffine3::IDENTITY,
            bodies: std::iter::once(body("base")).chain(joints.iter().map(|(name, _)| body(name))).collect(),
            joints: joints.iter().map(joint).collect(),
            shapes: Vec::new(),
        };
        let nominal = TreeModel::new(tree).expect("equal limits in both directions");
        Self::ideal("drives", nominal)
    }
}
