//! A robot of any shape as the engines simulate it: bodies, actuators and contact points.

use glam::DVec3;

use crate::{ActuatorParams, CONTACT, Contact, JointModel, RobotTree, Stribeck, TreeJoint, TreeShape, TreeShapeKind};

/// Robot of any tree with its actuators, and the points at which it touches the ground.
///
/// Positions, velocities and torques of sliding joints are in m, m/s and N.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeModel {
    /// Bodies, and the places and axes of joints. Numbers of joints that [`TreeModel::joints`] has too are not used.
    pub tree: RobotTree,
    /// Actuator, friction, spring and limits of each joint.
    pub joints: Vec<JointModel>,
    /// Points that touch the ground. Those of a body follow each other.
    pub points: Vec<ContactPoint>,
    /// Contact between the robot and the ground.
    pub contact: Contact,
}

/// Sphere, or point, that touches the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactPoint {
    /// Index of the shape in [`RobotTree::shapes`].
    pub shape: usize,
    /// Index of the body.
    pub body: usize,
    /// Centre in the frame of the body [m].
    pub centre: DVec3,
    /// Radius [m]; zero for a point.
    pub radius: f64,
}

impl TreeModel {
    /// Returns the robot with ideal actuators and the contact [`CONTACT`].
    ///
    /// Spheres, the ends of capsules and the corners of boxes touch the ground. Ellipsoids, cylinders and meshes do not.
    pub fn new(tree: RobotTree) -> Self {
        let joints = tree.joints.iter().map(joint_model).collect();
        let mut points: Vec<_> =
            tree.shapes.iter().enumerate().flat_map(|(index, shape)| contact_points(index, shape)).collect();
        points.sort_by_key(|point| point.body);
        Self { tree, joints, points, contact: CONTACT }
    }

    /// Returns the height [m] of an upright base at which the lowest contact point touches flat ground, with the joints at `q`.
    pub fn standing_height(&self, q: &[f64]) -> f64 {
        let poses = self.tree.base_from_bodies(q);
        let lowest = self.points.iter().map(|point| poses[point.body].transform_point3(point.centre).z - point.radius);
        -lowest.fold(f64::INFINITY, f64::min).min(0.0)
    }
}

/// Returns the joint with an ideal actuator.
fn joint_model(joint: &TreeJoint) -> JointModel {
    JointModel {
        range: joint.range,
        torque_limit: joint.effort.map_or(f64::INFINITY, |[low, high]| high.max(-low)),
        speed_limit: joint.speed_limit,
        armature: joint.armature,
        viscous_friction: joint.damping,
        coulomb_friction: joint.friction,
        stribeck_friction: Stribeck::NONE,
        load_friction: 0.0,
        spring: joint.spring,
        actuator: ActuatorParams::IDEAL,
    }
}

fn contact_points(index: usize, shape: &TreeShape) -> Vec<ContactPoint> {
    let point = |centre: DVec3, radius: f64| ContactPoint {
        shape: index,
        body: shape.body,
        centre: shape.body_from_shape.transform_point3(centre),
        radius,
    };
    match shape.kind {
        TreeShapeKind::Sphere(radius) => vec![point(DVec3::ZERO, radius)],
        TreeShapeKind::Capsule { radius, half_length } => {
            [-1.0, 1.0].map(|side| point(DVec3::new(0.0, 0.0, side * half_length), radius)).to_vec()
        }
        TreeShapeKind::Box(half) => (0..8)
            .map(|corner| {
                let sign = |bit: usize| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
                point(half * DVec3::new(sign(0), sign(1), sign(2)), 0.0)
            })
            .collect(),
        TreeShapeKind::Ellipsoid(_) | TreeShapeKind::Cylinder { .. } | TreeShapeKind::Mesh(_) => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, dvec3};

    use super::*;
    use crate::go2;

    #[test]
    fn capsule_has_its_ends_and_box_its_corners_as_contact_points() {
        let mut tree = RobotTree::from(&go2());
        let shape = |body: usize, kind: TreeShapeKind, at: DVec3| TreeShape {
            name: String::new(),
            body,
            kind,
            body_from_shape: DAffine3::from_translation(at),
        };
        tree.shapes = vec![
            shape(3, TreeShapeKind::Capsule { radius: 0.01, half_length: 0.1 }, dvec3(0.0, 0.0, -0.1)),
            shape(0, TreeShapeKind::Box(dvec3(0.2, 0.1, 0.05)), DVec3::ZERO),
        ];
        let model = TreeModel::new(tree);
        assert_eq!(model.points.len(), 10);
        assert!(model.points[..8].iter().all(|point| point.body == 0 && point.shape == 1));
        assert_eq!(model.points[8].centre, dvec3(0.0, 0.0, -0.2));
        // The capsule of the calf ends 0.2 m below its joint, which is below the trunk.
        let q = vec![0.0; 12];
        let calf = model.tree.base_from_bodies(&q)[3].translation.z;
        assert!((model.standing_height(&q) - (0.21 - calf)).abs() < 1e-12);
    }
}
