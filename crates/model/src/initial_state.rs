//! Initial state of a robot.

use glam::{Quat, Vec3};

use crate::{Ground, NUM_JOINTS, PerJoint, Pose, RobotModel, body_poses, frames};

/// State to which a robot is reset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitialState {
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: [f32; 3],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub base_orientation: [f32; 4],
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: [f32; 3],
    /// Angular velocity of the base, in the base frame [rad/s].
    pub base_angular_velocity: [f32; 3],
    /// Joint position [rad].
    pub q: PerJoint,
    /// Joint velocity [rad/s].
    pub dq: PerJoint,
    /// Random seed of the robot's actuators.
    pub actuator_seed: u64,
}

impl InitialState {
    /// Returns the state at rest and upright at height `base_height` [m], with joints at `q` [rad].
    pub fn at_rest(base_height: f32, q: PerJoint) -> Self {
        Self {
            base_position: [0.0, 0.0, base_height],
            base_orientation: [1.0, 0.0, 0.0, 0.0],
            base_linear_velocity: [0.0; 3],
            base_angular_velocity: [0.0; 3],
            q,
            dq: [0.0; NUM_JOINTS],
            actuator_seed: 0,
        }
    }

    /// Returns the state at rest above the origin of `ground`, parallel to its plane, with joints at `q` [rad].
    ///
    /// The collision point with the least distance to the ground is `clearance` [m] above it. The points are the feet,
    /// the knees, the calf ends, the hips and the corners of the trunk.
    pub fn standing_on(ground: &Ground, robot: &RobotModel, q: PerJoint, clearance: f32) -> Self {
        Self::turned_at(ground, robot, q, clearance, [0.0; 3], Quat::IDENTITY)
    }

    /// Returns the state as [`InitialState::standing_on`] does, above another point of the ground: x [m], y [m], and the yaw
    /// of the robot [rad]. The base is turned from there by a rotation in its own frame.
    pub fn turned_at(
        ground: &Ground,
        robot: &RobotModel,
        q: PerJoint,
        clearance: f32,
        [x, y, yaw]: [f32; 3],
        turned: Quat,
    ) -> Self {
        let rotation = Quat::from_rotation_arc(Vec3::Z, ground.up()) * Quat::from_rotation_z(yaw) * turned;
        let poses = body_poses(robot, Pose { position: Vec3::new(x, y, 0.0), rotation }, &q);
        let shapes = &robot.shapes;
        let half = shapes.trunk_half_size.as_vec3();
        let sign = |corner: u32, axis: u32| if corner >> axis & 1 == 0 { -1.0 } else { 1.0 };
        let corners = (0..8).map(|corner| half * Vec3::new(sign(corner, 0), sign(corner, 1), sign(corner, 2)));
        let trunk = corners.map(|corner| (poses[0].transform(corner), 0.0));
        let legs = (0..4).flat_map(|leg| {
            let (hip, calf) = (poses[1 + 3 * leg], poses[3 + 3 * leg]);
            let [knee, shin] = shapes.calf_ends.map(|end| (calf, end, shapes.calf_radius));
            let motors = (hip, robot.hip_centre(leg), shapes.hip_radius);
            [motors, knee, shin, (calf, shapes.foot_centre, shapes.foot_radius)]
                .map(|(body, centre, radius)| (body.transform(centre.as_vec3()), radius as f32))
        });
        let lift = trunk
            .chain(legs)
            .map(|(point, radius)| ground.clearance_height(point.x, point.y, radius) - point.z)
            .fold(f32::NEG_INFINITY, f32::max);
        let base_position = [x, y, lift + clearance];
        Self { base_position, base_orientation: frames::to_wxyz(rotation), ..Self::at_rest(0.0, q) }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::{HeightField, go2};

    /// Returns the vertical distance of each foot's sphere from the ground [m].
    fn gaps(placement: &InitialState, ground: &Ground) -> [f32; 4] {
        let robot = go2();
        let world_from_base = Pose {
            position: Vec3::from(placement.base_position),
            rotation: frames::world_from_base(placement.base_orientation),
        };
        let poses = body_poses(&robot, world_from_base, &placement.q);
        std::array::from_fn(|leg| {
            let centre = poses[3 + 3 * leg].transform(robot.shapes.foot_centre.as_vec3());
            centre.z - ground.clearance_height(centre.x, centre.y, robot.shapes.foot_radius as f32)
        })
    }

    /// Height of the rear feet above the front feet in the default pose with a level trunk [m].
    const REAR_FEET: f32 = 0.01;

    #[test]
    fn base_height_of_the_standing_default_pose_is_0_32_m() {
        let robot = go2();
        let placement = InitialState::standing_on(&Ground::FLAT, &robot, robot.control.default_pose_f32(), 0.0);
        assert!((placement.base_position[2] - 0.3235).abs() < 1e-4, "{:?}", placement.base_position);
        let [front_left, front_right, rear_left, rear_right] = gaps(&placement, &Ground::FLAT);
        assert!(front_left.abs().max(front_right.abs()) < 1e-6, "{front_left} {front_right}");
        assert!((rear_left - REAR_FEET).abs().max((rear_right - REAR_FEET).abs()) < 1e-3, "{rear_left} {rear_right}");
    }

    #[test]
    fn feet_have_the_same_distance_to_a_slope_as_to_flat_ground() {
        let robot = go2();
        let ground = Ground { normal: [-0.3f32.sin(), 0.0, 0.3f32.cos()], ..Ground::FLAT };
        let [level, sloping] = [&Ground::FLAT, &ground].map(|ground| {
            gaps(&InitialState::standing_on(ground, &robot, robot.control.default_pose_f32(), 0.0), ground)
        });
        for (level, sloping) in level.iter().zip(sloping) {
            assert!((level - sloping * 0.3f32.cos()).abs() < 1e-5, "{level} {sloping}");
        }
    }

    proptest! {
        #[test]
        fn lowest_foot_has_the_requested_clearance_on_rough_ground(seed: u64, bend in -0.2f32..0.2) {
            let robot = go2();
            let field = HeightField::random_uniform(0.1, 0.1, 40, seed).expect("a field");
            let ground = Ground { height_field: Some(Arc::new(field)), ..Ground::FLAT };
            let q = robot.control.default_pose_f32().map(|q| q + bend);
            let gaps = gaps(&InitialState::standing_on(&ground, &robot, q, 0.01), &ground);
            let nearest = gaps.into_iter().fold(f32::INFINITY, f32::min);
            prop_assert!((nearest - 0.01).abs() < 1e-5, "{gaps:?}");
        }
    }
}
