//! Forward kinematics: pose of each body from the base pose and the joint positions.

use glam::{Quat, Vec3};

use crate::{Joint, NUM_JOINTS, PerJoint, RobotModel};

/// Number of bodies of the robot: the trunk and the child link of each joint.
pub const NUM_BODIES: usize = 1 + NUM_JOINTS;
/// Height of a fixed base [m], at which no foot reaches the ground.
pub const FIXED_BASE_HEIGHT: f64 = 1.0;

/// Pose of a frame in a reference frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position of the frame's origin in the reference frame [m].
    pub position: Vec3,
    /// Rotation from the frame to the reference frame.
    pub rotation: Quat,
}

impl Pose {
    /// Pose of the reference frame itself.
    pub const IDENTITY: Pose = Pose { position: Vec3::ZERO, rotation: Quat::IDENTITY };

    /// Returns `point` [m, frame] in the reference frame [m].
    pub fn transform(self, point: Vec3) -> Vec3 {
        self.position + self.rotation * point
    }

    /// Returns `[x, y, z, w, x, y, z]`: position [m], then quaternion.
    pub fn to_array(self) -> [f32; 7] {
        let (position, rotation) = (self.position, self.rotation);
        [position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z]
    }
}

/// Returns world-from-body of the trunk, then of the child link of each joint in the order of [`Joint::ALL`].
///
/// `q` are joint positions [rad]. The origin of a link's frame is at its joint. A calf includes the foot.
pub fn body_poses(robot: &RobotModel, world_from_base: Pose, q: &PerJoint) -> [Pose; NUM_BODIES] {
    let mut poses = [world_from_base; NUM_BODIES];
    for joint in Joint::ALL {
        let index = joint.index();
        // `poses[index]` belongs to the previous joint of the same leg; the parent of a hip is the trunk.
        let parent = if joint.kind == crate::JointKind::Hip { world_from_base } else { poses[index] };
        let origin = robot.legs[joint.leg as usize].origins[joint.kind as usize].as_vec3();
        let parent_from_body = Quat::from_axis_angle(RobotModel::axis(joint).as_vec3(), q[index]);
        poses[1 + index] = Pose { position: parent.transform(origin), rotation: parent.rotation * parent_from_body };
    }
    poses
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{Leg, go2};

    fn foot(robot: &RobotModel, leg: Leg, world_from_base: Pose, q: &PerJoint) -> Vec3 {
        let calf = body_poses(robot, world_from_base, q)[3 + 3 * leg as usize];
        calf.transform(robot.shapes.foot_centre.as_vec3())
    }

    #[test]
    fn foot_height_agrees_with_planar_trigonometry() {
        let robot = go2();
        let q = robot.control.default_pose_f32();
        for leg in Leg::ALL {
            let [hip, thigh, calf] = [q[3 * leg as usize], q[3 * leg as usize + 1], q[3 * leg as usize + 2]];
            // Both links are 0.213 m long; the centre of the foot is 2 mm behind the end of the lower one.
            let shin = thigh + calf;
            let down = 0.213 * thigh.cos() + 0.213 * shin.cos() - 0.002 * shin.sin();
            let sideways = leg.left_sign() as f32 * 0.0955;
            let height = sideways * hip.sin() - down * hip.cos();
            assert!((foot(&robot, leg, Pose::IDENTITY, &q).z - height).abs() < 1e-6, "{leg:?}");
        }
    }

    proptest! {
        #[test]
        fn left_and_right_legs_are_mirror_images(hip in -1.0f32..1.0, thigh in -1.0f32..3.0, calf in -2.7f32..-0.9) {
            let robot = go2();
            let q = Joint::ALL.map(|joint| match joint.kind {
                crate::JointKind::Hip => hip * joint.leg.left_sign() as f32,
                crate::JointKind::Thigh => thigh,
                crate::JointKind::Calf => calf,
            });
            let [left, right] = [Leg::RL, Leg::RR].map(|leg| foot(&robot, leg, Pose::IDENTITY, &q));
            prop_assert!((left - right * Vec3::new(1.0, -1.0, 1.0)).length() < 1e-6);
        }

        #[test]
        fn base_pose_transforms_every_body(yaw in -3.0f32..3.0, x in -5.0f32..5.0) {
            let robot = go2();
            let q = robot.control.default_pose_f32();
            let world_from_base = Pose { position: Vec3::new(x, 1.0, 0.3), rotation: Quat::from_rotation_z(yaw) };
            for (moved, own) in
                body_poses(&robot, world_from_base, &q).iter().zip(body_poses(&robot, Pose::IDENTITY, &q))
            {
                prop_assert!((moved.position - world_from_base.transform(own.position)).length() < 1e-5);
            }
        }
    }
}
