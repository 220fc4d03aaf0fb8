//! Rotations between the world and the base.

use glam::{Quat, Vec3};

/// Returns the rotation world-from-base of an orientation `[w, x, y, z]`.
#[inline]
pub fn world_from_base([w, x, y, z]: [f32; 4]) -> Quat {
    Quat::from_xyzw(x, y, z, w)
}

/// Returns the orientation as `[w, x, y, z]`, the order in states and logs.
pub fn to_wxyz(rotation: Quat) -> [f32; 4] {
    [rotation.w, rotation.x, rotation.y, rotation.z]
}

/// Returns the unit vector of gravity in the base frame; (0, 0, −1) for an upright robot (U2E, eq. 14, `g_t`).
#[inline]
pub fn projected_gravity(orientation_wxyz: [f32; 4]) -> Vec3 {
    world_from_base(orientation_wxyz).inverse() * Vec3::NEG_Z
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn gravity_points_forward_in_the_frame_of_a_robot_that_is_pitched_down() {
        let nose_down = Quat::from_rotation_y(0.3);
        let gravity = projected_gravity(to_wxyz(nose_down));
        assert!(gravity.x > 0.29 && gravity.y.abs() < 1e-6 && gravity.z < -0.95, "{gravity}");
    }

    proptest! {
        #[test]
        fn yaw_does_not_change_projected_gravity(yaw in -3.0f32..3.0, pitch in -1.0f32..1.0) {
            let tilted = projected_gravity(to_wxyz(Quat::from_rotation_y(pitch)));
            let turned = projected_gravity(to_wxyz(Quat::from_rotation_z(yaw) * Quat::from_rotation_y(pitch)));
            prop_assert!((tilted - turned).length() < 1e-5);
        }
    }
}
