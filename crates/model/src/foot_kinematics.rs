//! Position and velocity of the feet in the base frame, from joint positions and velocities.

use glam::Vec3;

use crate::{NUM_LEGS, PerJoint, RobotModel};

/// Lengths of the legs of a robot, for the motion of its feet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootKinematics {
    /// Position of each joint in its parent's frame, by leg [m].
    origins: [[Vec3; 3]; NUM_LEGS],
    /// Centre of the foot in the frame of the calf [m].
    foot_centre: Vec3,
}

/// Motion of a foot's centre relative to the base, in the base frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootMotion {
    /// Position [m].
    pub position: Vec3,
    /// Velocity in the rotating base frame [m/s].
    pub velocity: Vec3,
}

impl FootKinematics {
    /// Reads the lengths of the legs of `robot`.
    pub fn new(robot: &RobotModel) -> Self {
        Self {
            origins: std::array::from_fn(|leg| robot.legs[leg].origins.map(glam::DVec3::as_vec3)),
            foot_centre: robot.shapes.foot_centre.as_vec3(),
        }
    }

    /// Returns the motion of the feet in the order FL, FR, RL, RR. `q` [rad] and `dq` [rad/s] are those of the joints.
    pub fn feet(&self, q: &PerJoint, dq: &PerJoint) -> [FootMotion; NUM_LEGS] {
        std::array::from_fn(|leg| {
            let [hip, thigh, calf] = self.origins[leg];
            let joint = 3 * leg;
            let (in_calf, turned) = rotate_y(self.foot_centre, q[joint + 2]);
            let lower = (calf + in_calf, turned * dq[joint + 2]);
            let (in_thigh, turned) = rotate_y(lower.0, q[joint + 1]);
            let (velocity, _) = rotate_y(lower.1, q[joint + 1]);
            let upper = (thigh + in_thigh, velocity + turned * dq[joint + 1]);
            let (in_hip, turned) = rotate_x(upper.0, q[joint]);
            let (velocity, _) = rotate_x(upper.1, q[joint]);
            FootMotion { position: hip + in_hip, velocity: velocity + turned * dq[joint] }
        })
    }
}

/// Returns `vector` rotated about y by `angle` [rad], and the derivative with respect to the angle.
fn rotate_y(vector: Vec3, angle: f32) -> (Vec3, Vec3) {
    let (sin, cos) = angle.sin_cos();
    let rotated = Vec3::new(cos * vector.x + sin * vector.z, vector.y, cos * vector.z - sin * vector.x);
    (rotated, Vec3::new(rotated.z, 0.0, -rotated.x))
}

/// Returns `vector` rotated about x by `angle` [rad], and the derivative with respect to the angle.
fn rotate_x(vector: Vec3, angle: f32) -> (Vec3, Vec3) {
    let (sin, cos) = angle.sin_cos();
    let rotated = Vec3::new(vector.x, cos * vector.y - sin * vector.z, sin * vector.y + cos * vector.z);
    (rotated, Vec3::new(0.0, -rotated.z, rotated.y))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::kinematics::{Pose, body_poses};
    use crate::{NUM_JOINTS, go2};

    proptest! {
        #[test]
        fn positions_are_those_of_forward_kinematics_and_velocities_their_derivatives(
            q in prop::array::uniform12(-1.5f32..1.5), dq in prop::array::uniform12(-5.0f32..5.0),
        ) {
            let robot = go2();
            let feet = FootKinematics::new(&robot).feet(&q, &dq);
            let at = |time: f32| {
                let moved: [f32; NUM_JOINTS] = std::array::from_fn(|joint| q[joint] + time * dq[joint]);
                let poses = body_poses(&robot, Pose::IDENTITY, &moved);
                std::array::from_fn::<_, 4, _>(|leg| {
                    poses[3 + 3 * leg].transform(robot.shapes.foot_centre.as_vec3())
                })
            };
            let (before, now, after) = (at(-1e-3), at(0.0), at(1e-3));
            for leg in 0..NUM_LEGS {
                prop_assert!((feet[leg].position - now[leg]).length() < 1e-5);
                let difference = (after[leg] - before[leg]) / 2e-3;
                // Single precision and the step of 1 ms leave 1e-3 m/s.
                prop_assert!((feet[leg].velocity - difference).length() < 3e-3, "{} {difference}", feet[leg].velocity);
            }
        }
    }
}
