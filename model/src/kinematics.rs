//! Forward kinematics: where each body of a robot is, given its trunk and its joints.

use glam::{Quat, Vec3};

use crate::{Joint, NUM_JOINTS, PerJoint, RobotModel};

/// Number of bodies of the robot: the trunk and one behind each joint.
pub const NUM_BODIES: usize = 1 + NUM_JOINTS;
/// Height of the base [m] at which a held robot hangs: no foot reaches the ground.
pub const FIXED_BASE_HEIGHT: f64 = 1.0;

/// Pose of a frame in another one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Origin [m].
    pub position: Vec3,
    /// Rotation from the frame to the other one.
    pub rotation: Quat,
}

impl Pose {
    /// The frame itself.
    pub const IDENTITY: Pose = Pose { position: Vec3::ZERO, rotation: Quat::IDENTITY };

    /// The point `point` of the frame [m], seen from the other one.
    pub fn transform(self, point: Vec3) -> Vec3 {
        self.position + self.rotation * point
    }

    /// `[x, y, z, w, x, y, z]`: position [m], then quaternion.
    pub fn to_array(self) -> [f32; 7] {
        let (position, rotation) = (self.position, self.rotation);
        [position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z]
    }
}

/// World-from-body of the trunk and of the body behind each joint, in the order of [`Joint::ALL`].
///
/// `q` are joint positions [rad]. A body's frame sits at its joint; a calf's includes the foot.
pub fn body_poses(robot: &RobotModel, world_from_base: Pose, q: &PerJoint) -> [Pose; NUM_BODIES] {
    let mut poses = [world_from_base; NUM_BODIES];
    for joint in Joint::ALL {
        let index = joint.index();
        // `poses[index]` is the joint before in the same leg; a hip hangs on the trunk.
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
    fn foot_hangs_below_the_hip_as_the_law_of_cosines_says() {
        let robot = go2();
        let q = robot.control.default_pose_f32();
        for leg in Leg::ALL {
            let [hip, thigh, calf] = [q[3 * leg as usize], q[3 * leg as usize + 1], q[3 * leg as usize + 2]];
            // Both links are 0.213 m long; the foot's centre lies 2 mm behind the end of the lower one.
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
        fn moving_the_trunk_moves_every_body_with_it(yaw in -3.0f32..3.0, x in -5.0f32..5.0) {
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
