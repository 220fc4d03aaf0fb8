//! Scene for rendering one robot: bodies, their shapes and poses, and the ground.

use glam::{DAffine3, DVec3};

use crate::kinematics::{Pose, body_poses};
use crate::look::look;
use crate::scene_shape::{SceneShape, ShapeKind, capsule};
use crate::{Ground, JOINT_NAMES, PerJoint, RobotModel, RobotTree, TreeShape, TreeShapeKind};

/// Scene for rendering. Poses are `[x, y, z, w, x, y, z]`: position [m], then quaternion.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Names of the bodies; the first is the trunk.
    pub bodies: Vec<String>,
    /// Pose world-from-body of each body.
    pub pose: Vec<[f32; 7]>,
    /// Shapes of the bodies; the same in every scene of a robot.
    pub shapes: Vec<SceneShape>,
    /// The ground; a height field is cropped around the robot.
    pub ground: Ground,
    /// Commanded base velocity in the base frame: forward [m/s], left [m/s], yaw [rad/s]. `None` if the task has none.
    pub command: Option<[f32; 3]>,
    /// Velocity in the base frame: forward [m/s], left [m/s], yaw [rad/s]. `None` if it is not known; a server does not send it.
    pub velocity: Option<[f32; 3]>,
    /// Torque of each joint [N·m], or force [N]; joint `i` moves body `i + 1`. `None` if it is not known; a server does not send it.
    pub torque: Option<Vec<f32>>,
    /// Normal force on each foot of a quadruped, or on each shape of a tree [N]. `None` if it is not known; a server does not send it.
    pub contact_force: Option<Vec<f32>>,
    /// Weighted reward terms of the last step. Empty if they are not known; a server does not send them.
    pub reward_terms: Vec<f32>,
    /// Epistemic uncertainty of the actuators [nat]. `None` if it is not known; a server does not send it.
    pub uncertainty: Option<f32>,
}

impl Scene {
    /// Returns the scene of a robot with this pose of its base and joint positions `q` [rad], on `ground`.
    pub fn new(robot: &RobotModel, world_from_base: Pose, q: &PerJoint, ground: &Ground) -> Self {
        let poses = body_poses(robot, world_from_base, q);
        Self {
            bodies: ["trunk"].iter().chain(&JOINT_NAMES).map(ToString::to_string).collect(),
            pose: poses.map(Pose::to_array).to_vec(),
            shapes: look(robot),
            ground: ground.crop(world_from_base.position.x, world_from_base.position.y),
            command: None,
            velocity: None,
            torque: None,
            contact_force: None,
            reward_terms: Vec::new(),
            uncertainty: None,
        }
    }
}

impl Scene {
    /// Returns the scene of a robot of any tree: its shapes, and rods from each joint to the next and to its spheres, because many files have no other shapes.
    pub fn of_tree(tree: &RobotTree, world_from_base: DAffine3, q: &[f64], ground: &Ground) -> Self {
        let pose = |body: DAffine3| pose_of(world_from_base * body).to_array();
        let longest = tree.joints.iter().map(|joint| joint.parent_from_child.translation.length()).fold(0.0, f64::max);
        let rods = tree.joints.iter().filter(|joint| joint.parent_from_child.translation.length() > 1e-3);
        let rod = |joint: &crate::TreeJoint| {
            capsule(joint.parent as u32, 0.06 * longest, [DVec3::ZERO, joint.parent_from_child.translation])
        };
        let feet = tree.shapes.iter().filter(|shape| matches!(shape.kind, TreeShapeKind::Sphere(_)));
        let feet = feet.filter(|shape| shape.body_from_shape.translation.length() > 1e-3);
        let shank = |shape: &TreeShape| {
            capsule(shape.body as u32, 0.04 * longest, [DVec3::ZERO, shape.body_from_shape.translation])
        };
        let position = world_from_base.translation;
        Self {
            bodies: tree.bodies.iter().map(|body| body.name.clone()).collect(),
            pose: tree.base_from_bodies(q).into_iter().map(pose).collect(),
            shapes: tree.shapes.iter().filter_map(tree_shape).chain(rods.map(rod)).chain(feet.map(shank)).collect(),
            ground: ground.crop(position.x as f32, position.y as f32),
            command: None,
            velocity: None,
            torque: None,
            contact_force: None,
            reward_terms: Vec::new(),
            uncertainty: None,
        }
    }
}

fn pose_of(frame: DAffine3) -> Pose {
    let (_, rotation, position) = frame.to_scale_rotation_translation();
    Pose { position: position.as_vec3(), rotation: rotation.as_quat() }
}

/// Returns a shape as it is drawn: an ellipsoid and a mesh as the box around them. `None` for a mesh without bounds.
fn tree_shape(shape: &TreeShape) -> Option<SceneShape> {
    let mut frame = shape.body_from_shape;
    let (kind, size) = match shape.kind {
        TreeShapeKind::Box(half) | TreeShapeKind::Ellipsoid(half) => (ShapeKind::Box, half),
        TreeShapeKind::Sphere(radius) => (ShapeKind::Sphere, DVec3::new(radius, 0.0, 0.0)),
        TreeShapeKind::Capsule { radius, half_length } => (ShapeKind::Capsule, DVec3::new(radius, half_length, 0.0)),
        TreeShapeKind::Cylinder { radius, half_length } => (ShapeKind::Cylinder, DVec3::new(radius, half_length, 0.0)),
        TreeShapeKind::Mesh(bounds) => {
            let [low, high] = bounds?;
            frame *= DAffine3::from_translation(0.5 * (low + high));
            (ShapeKind::Box, 0.5 * (high - low))
        }
    };
    Some(crate::scene_shape::shape(shape.body as u32, kind, size, pose_of(frame)))
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};

    use super::*;
    use crate::{NUM_BODIES, go2};

    fn standing() -> Scene {
        let robot = go2();
        let world_from_base = Pose { position: Vec3::new(0.0, 0.0, 0.32), rotation: Quat::IDENTITY };
        Scene::new(&robot, world_from_base, &robot.control.default_pose_f32(), &Ground::FLAT)
    }

    #[test]
    fn every_body_has_a_name_a_pose_and_a_shape() {
        let scene = standing();
        assert_eq!((scene.bodies.len(), scene.pose.len()), (NUM_BODIES, NUM_BODIES));
        for body in 0..NUM_BODIES as u32 {
            assert!(scene.shapes.iter().any(|shape| shape.body == body), "{}", scene.bodies[body as usize]);
        }
    }

    #[test]
    fn scene_of_a_tree_has_the_poses_of_the_quadruped_and_a_rod_for_each_link() {
        let (robot, quadruped) = (go2(), standing());
        let base = DAffine3::from_translation(DVec3::new(0.0, 0.0, 0.32));
        let scene = Scene::of_tree(&RobotTree::from(&robot), base, &robot.control.default_pose, &Ground::FLAT);
        assert_eq!(scene.bodies, quadruped.bodies);
        for (one, other) in scene.pose.iter().flatten().zip(quadruped.pose.iter().flatten()) {
            assert!((one - other).abs() < 1e-5, "{one} {other}");
        }
        assert_eq!(scene.shapes.len(), 12);
    }
}
