//! What a rapier world needs of a robot.

use glam::{DAffine3, DQuat, DVec3};
use rapier3d::prelude::*;
use twinstep_model::{
    Contact, JointModel, RigidBody, RobotModel, RobotTree, TreeJointKind, TreeModel, TreeShape, TreeShapeKind,
};

/// Robot whose frames are parallel at position 0 of all joints.
pub struct WorldRobot {
    /// Base.
    pub base: RigidBody,
    /// Links, one for each joint, after their parents.
    pub links: Vec<WorldLink>,
    /// Actuators, friction and limits of the joints.
    pub joints: Vec<JointModel>,
    /// Body of each collision shape, and the shape.
    pub shapes: Vec<(usize, ColliderBuilder)>,
    /// Index in the tree of each collision shape; empty for a quadruped.
    pub shapes_of_tree: Vec<usize>,
    /// Contact with the ground.
    pub contact: Contact,
    /// Reading of the gyroscope at rest [rad/s].
    pub gyro_bias: DVec3,
    /// Actuator period [s].
    pub actuator_dt: f64,
}

/// Body with the joint that moves it.
pub struct WorldLink {
    /// Index of the parent: 0 is the base, link `i` is body `i + 1`.
    pub parent: usize,
    /// Origin of the joint in the frame of the parent [m].
    pub origin: DVec3,
    /// Axis of the joint.
    pub axis: DVec3,
    /// Kind of the joint.
    pub kind: TreeJointKind,
    /// Mass.
    pub body: RigidBody,
}

impl WorldRobot {
    /// Returns a robot of any tree.
    pub fn of_tree(robot: &TreeModel, actuator_dt: f64) -> Self {
        let tree = robot.tree.with_parallel_frames();
        let shapes = tree.shapes.iter().enumerate();
        let shapes = shapes.filter_map(|(index, shape)| Some((index, (shape.body, collider(shape)?))));
        let (shapes_of_tree, shapes) = shapes.unzip();
        Self {
            base: tree.bodies[0].inertia,
            links: links(&tree),
            joints: robot.joints.clone(),
            shapes,
            shapes_of_tree,
            contact: robot.contact,
            gyro_bias: DVec3::ZERO,
            actuator_dt,
        }
    }

    /// Returns a quadruped. Its shapes are the trunk, then hip, thigh, calf and foot of each leg.
    pub fn of_quadruped(robot: &RobotModel) -> Self {
        let tree = RobotTree::from(robot);
        let body = |leg: usize, kind: usize| 1 + 3 * leg + kind;
        let of_leg = (0..4).flat_map(|leg| {
            [
                (body(leg, 0), hip_sphere(robot, leg)),
                (body(leg, 1), thigh_box(robot)),
                (body(leg, 2), calf_capsule(robot)),
                (body(leg, 2), foot_sphere(robot)),
            ]
        });
        Self {
            base: robot.trunk,
            links: links(&tree),
            joints: robot.joints.to_vec(),
            shapes: std::iter::once((0, trunk_box(robot))).chain(of_leg).collect(),
            shapes_of_tree: Vec::new(),
            contact: robot.contact,
            gyro_bias: robot.gyro_bias,
            actuator_dt: robot.control.actuator_dt(),
        }
    }
}

/// Returns the index of the foot of a leg among the shapes of a quadruped.
pub fn foot_shape(leg: usize) -> usize {
    4 + 4 * leg
}

/// Returns true if a shape of a quadruped is the trunk, a hip or a thigh.
pub fn is_upper_body(shape: usize) -> bool {
    shape == 0 || matches!(shape % 4, 1 | 2)
}

fn links(tree: &RobotTree) -> Vec<WorldLink> {
    let joints = tree.joints.iter().zip(&tree.bodies[1..]);
    joints
        .map(|(joint, body)| WorldLink {
            parent: joint.parent,
            origin: joint.parent_from_child.translation,
            axis: joint.axis,
            kind: joint.kind,
            body: body.inertia,
        })
        .collect()
}

/// Returns the shape of a tree; `None` if the engines do not let it touch the ground.
fn collider(shape: &TreeShape) -> Option<ColliderBuilder> {
    let builder = match shape.kind {
        TreeShapeKind::Sphere(radius) => ColliderBuilder::ball(radius as f32),
        TreeShapeKind::Capsule { radius, half_length } => ColliderBuilder::capsule_z(half_length as f32, radius as f32),
        TreeShapeKind::Box(half) => ColliderBuilder::cuboid(half.x as f32, half.y as f32, half.z as f32),
        TreeShapeKind::Ellipsoid(_) | TreeShapeKind::Cylinder { .. } | TreeShapeKind::Mesh(_) => return None,
    };
    let DAffine3 { matrix3, translation } = shape.body_from_shape;
    let rotation = DQuat::from_mat3(&matrix3).as_quat();
    Some(builder.position(Pose::from_parts(translation.as_vec3(), rotation)))
}

fn trunk_box(robot: &RobotModel) -> ColliderBuilder {
    let half = robot.shapes.trunk_half_size.as_vec3();
    ColliderBuilder::cuboid(half.x, half.y, half.z)
}

fn hip_sphere(robot: &RobotModel, leg: usize) -> ColliderBuilder {
    ColliderBuilder::ball(robot.shapes.hip_radius as f32).translation(robot.hip_centre(leg).as_vec3())
}

fn thigh_box(robot: &RobotModel) -> ColliderBuilder {
    let half = robot.shapes.thigh_half_size.as_vec3();
    ColliderBuilder::cuboid(half.x, half.y, half.z).translation(robot.shapes.thigh_centre.as_vec3())
}

fn calf_capsule(robot: &RobotModel) -> ColliderBuilder {
    let [knee, shin] = [robot.shapes.calf_ends[0].as_vec3(), robot.shapes.calf_ends[1].as_vec3()];
    ColliderBuilder::capsule_from_endpoints(knee, shin, robot.shapes.calf_radius as f32)
}

fn foot_sphere(robot: &RobotModel) -> ColliderBuilder {
    ColliderBuilder::ball(robot.shapes.foot_radius as f32).translation(robot.shapes.foot_centre.as_vec3())
}
