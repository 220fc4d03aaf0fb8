//! Numbers of all joints, and the state of a batch of robots, one per lane.

use std::ops::IndexMut;

use twinstep_simd::SimdFloat;

use crate::Vec3;

/// One number for each of some joints: an array if their number is known when the program is compiled, else a vector.
pub trait JointValues<T>:
    Clone + Send + Sync + AsRef<[T]> + AsMut<[T]> + IndexMut<usize, Output = T> + 'static
{
    /// Returns `value` for each of `len` joints.
    fn filled(len: usize, value: T) -> Self;
}

impl<T: SimdFloat, const N: usize> JointValues<T> for [T; N] {
    #[inline(always)]
    fn filled(len: usize, value: T) -> Self {
        debug_assert_eq!(len, N);
        [value; N]
    }
}

impl<T: SimdFloat> JointValues<T> for Vec<T> {
    fn filled(len: usize, value: T) -> Self {
        vec![value; len]
    }
}

/// Positions and velocities of a batch of robots, one per lane. `J` has a number for each joint.
#[derive(Clone, Copy, Debug)]
pub struct State<T, J> {
    /// Base origin in the world frame [m].
    pub position: Vec3<T>,
    /// World-from-base, w x y z.
    pub orientation: [T; 4],
    /// Velocity of the base origin in the world frame [m/s].
    pub linear_velocity: Vec3<T>,
    /// Angular velocity in the base frame [rad/s].
    pub angular_velocity: Vec3<T>,
    /// Joint positions [rad or m].
    pub q: J,
    /// Joint velocities [rad/s or m/s].
    pub dq: J,
}

impl<T: SimdFloat, J: JointValues<T>> State<T, J> {
    /// Returns the state at the world's origin, upright and at rest, with all joints at 0.
    pub fn origin(num_joints: usize) -> Self {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        Self {
            position: Vec3::zero(),
            orientation: [one, zero, zero, zero],
            linear_velocity: Vec3::zero(),
            angular_velocity: Vec3::zero(),
            q: J::filled(num_joints, zero),
            dq: J::filled(num_joints, zero),
        }
    }
}

impl<T: SimdFloat, J> State<T, J> {
    /// Returns the velocity of the base in base axes: angular [rad/s], then linear of its origin [m/s].
    #[inline(always)]
    pub fn base_velocity(&self) -> [T; 6] {
        let (axes, Vec3([p, q, r]), v) = (self.world_axes(), self.angular_velocity, self.linear_velocity);
        let along = |axis: usize| axes[0].0[axis] * v.0[0] + axes[1].0[axis] * v.0[1] + axes[2].0[axis] * v.0[2];
        [p, q, r, along(0), along(1), along(2)]
    }

    /// Returns the axes of the world frame in base coordinates.
    #[inline(always)]
    pub fn world_axes(&self) -> [Vec3<T>; 3] {
        let [w, x, y, z] = self.orientation;
        let (one, two) = (T::splat(1.0), T::splat(2.0));
        [
            Vec3([one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)]),
            Vec3([two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)]),
            Vec3([two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)]),
        ]
    }
}
