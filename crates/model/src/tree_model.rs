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

/// The actuators of the engines have no counterpart of a joint's actuators.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("joint `{joint}`: its force is {low} to {high}; as much in both directions expected")]
pub struct AsymmetricForce {
    /// Name of the joint.
    pub joint: String,
    /// Lowest force [N·m or N].
    pub low: f64,
    /// Highest force [N·m or N].
    pub high: f64,
}

impl TreeModel {
    /// Returns the robot with ideal actuators and the contact [`CONTACT`].
    ///
    /// A joint is passive if its file states actuators for other joints only. Without any, every joint has an actuator without limit.
    pub fn new(tree: RobotTree) -> Result<Self, AsymmetricForce> {
        let has_actuators = tree.joints.iter().any(|joint| joint.effort.is_some());
        let of_others = if has_actuators { 0.0 } else { f64::INFINITY };
        let joint = |joint: &TreeJoint| match joint.effort {
            None => Ok(joint.with_ideal_actuator(of_others)),
            Some([low, high]) if is_symmetric(low, high) => Ok(joint.with_ideal_actuator(high)),
            Some([low, high]) => Err(AsymmetricForce { joint: joint.name.clone(), low, high }),
        };
        let joints = tree.joints.iter().map(joint).collect::<Result<_, _>>()?;
        let points = tree.contact_points();
        Ok(Self { tree, joints, points, contact: CONTACT })
    }
}

impl TreeModel {
    /// Returns the tree with the numbers of [`TreeModel::joints`]: range, limit of the torque, rotor, friction and spring.
    #[must_use]
    pub fn plain_tree(&self) -> RobotTree {
        let mut tree = self.tree.clone();
        for (own, joint) in tree.joints.iter_mut().zip(&self.joints) {
            own.range = joint.range;
            // A joint without actuator stays without.
            own.effort = (joint.torque_limit > 0.0).then_some([-joint.torque_limit, joint.torque_limit]);
            (own.armature, own.damping) = (joint.armature, joint.viscous_friction);
            (own.friction, own.spring) = (joint.coulomb_friction, joint.spring);
        }
        tree
    }
}

/// Returns true if a range is as large in both directions.
fn is_symmetric(low: f64, high: f64) -> bool {
    low == -high || (low + high).abs() <= 1e-9 * high
}

impl RobotTree {
    /// Returns the points that touch the ground: spheres, the ends of capsules and the corners of boxes. Those of a body follow each other.
    pub fn contact_points(&self) -> Vec<ContactPoint> {
        let shapes = self.shapes.iter().enumerate();
        let mut points: Vec<_> = shapes.flat_map(|(index, shape)| contact_points(index, shape)).collect();
        points.sort_by_key(|point| point.body);
        points
    }

    /// Returns the names of the shapes that have no contact point: ellipsoids, cylinders and meshes.
    pub fn shapes_without_contact(&self) -> Vec<&str> {
        let shapes = self.shapes.iter().filter(|shape| contact_points(0, shape).is_empty());
        shapes.map(|shape| shape.name.as_str()).collect()
    }

    /// Returns the height [m] of an upright base at which the lowest contact point touches flat ground, with the joints at `q`.
    pub fn standing_height(&self, q: &[f64]) -> f64 {
        let (poses, points) = (self.base_from_bodies(q), self.contact_points());
        let heights = points.iter().map(|point| poses[point.body].transform_point3(point.centre).z - point.radius);
        -heights.fold(f64::INFINITY, f64::min).min(0.0)
    }
}

impl TreeJoint {
    /// Returns the joint with an actuator without delay, lag or loss.
    pub fn with_ideal_actuator(&self, torque_limit: f64) -> JointModel {
        JointModel {
            range: self.range,
            torque_limit,
            speed_limit: self.speed_limit,
            armature: self.armature,
            viscous_friction: self.damping,
            coulomb_friction: self.friction,
            stribeck_friction: Stribeck::NONE,
            load_friction: 0.0,
            spring: self.spring,
            actuator: ActuatorParams::IDEAL,
        }
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
        let model = TreeModel::new(tree).expect("equal limits");
        assert_eq!(model.points.len(), 10);
        assert!(model.points[..8].iter().all(|point| point.body == 0 && point.shape == 1));
        assert_eq!(model.points[8].centre, dvec3(0.0, 0.0, -0.2));
        // The capsule of the calf ends 0.2 m below its joint, which is below the trunk.
        let q = vec![0.0; 12];
        let calf = model.tree.base_from_bodies(&q)[3].translation.z;
        assert!((model.tree.standing_height(&q) - (0.21 - calf)).abs() < 1e-12);
    }

    #[test]
    fn joint_without_an_actuator_among_others_is_passive() {
        let mut tree = RobotTree::from(&go2());
        tree.joints[2].effort = None;
        let model = TreeModel::new(tree.clone()).expect("equal limits");
        assert_eq!((model.joints[1].torque_limit, model.joints[2].torque_limit), (23.7, 0.0));
        tree.joints.iter_mut().for_each(|joint| joint.effort = None);
        assert_eq!(TreeModel::new(tree).expect("no limits").joints[2].torque_limit, f64::INFINITY);
    }

    #[test]
    fn force_that_differs_by_direction_is_refused() {
        let mut tree = RobotTree::from(&go2());
        tree.joints[4].effort = Some([0.0, 20.0]);
        let error = TreeModel::new(tree).expect_err("a cable").to_string();
        assert_eq!(error, "joint `FR_thigh`: its force is 0 to 20; as much in both directions expected");
    }
}
