//! The ground of the batch engine: a plane, or a height field with one tangent plane per contact point.

use std::sync::Arc;

use glam::DVec3;
use twinstep_dynamics::{State, Vec3};
use twinstep_model::{Ground, HeightField};
use twinstep_simd::SimdFloat;

/// Ground under robots in SIMD lanes.
#[derive(Clone, Debug)]
pub enum SimdTerrain<T> {
    /// A plane through the origin: its normal and two tangents, in the world frame.
    Plane([Vec3<T>; 3]),
    /// A height field, and its maximum height [m].
    Field(Arc<HeightField>, T),
}

impl<T: SimdFloat> SimdTerrain<T> {
    /// Converts the ground of a backend.
    pub fn new(ground: &Ground) -> Self {
        if let Some(field) = &ground.height_field {
            let highest = field.heights().iter().copied().fold(f32::NEG_INFINITY, f32::max);
            return Self::Field(field.clone(), T::splat(f64::from(highest)));
        }
        let normal = DVec3::from(ground.normal.map(f64::from));
        let across = normal.cross(DVec3::X).normalize();
        Self::Plane([normal, across.cross(normal), across].map(Vec3::splat))
    }

    /// Returns the ground relative to the bases in this state.
    #[inline(always)]
    pub fn local_ground<J>(&self, state: &State<T, J>) -> LocalTerrain<'_, T> {
        let axes = state.world_axes();
        let (plane, height) = match self {
            Self::Plane(plane) => (*plane, plane[0].dot(state.position)),
            Self::Field(_, highest) => {
                let (zero, one) = (T::splat(0.0), T::splat(1.0));
                let level = [Vec3([zero, zero, one]), Vec3([one, zero, zero]), Vec3([zero, one, zero])];
                (level, state.position.0[2] - *highest)
            }
        };
        let directions = [to_base(plane[0], &axes), to_base(plane[1], &axes), to_base(plane[2], &axes)];
        let velocity = to_base(state.linear_velocity, &axes);
        LocalTerrain { terrain: self, position: state.position, axes, velocity, directions, height }
    }
}

/// Ground relative to the base.
pub struct LocalTerrain<'a, T> {
    terrain: &'a SimdTerrain<T>,
    position: Vec3<T>,
    /// Axes of the world in the base frame.
    axes: [Vec3<T>; 3],
    /// Velocity of the base origin in the base frame [m/s].
    pub velocity: Vec3<T>,
    /// Normal and tangents of the plane, or of the horizontal plane at the maximum height, in the base frame.
    directions: [Vec3<T>; 3],
    /// Height of the base origin above that plane [m].
    height: T,
}

/// Tangent plane of the ground below a point.
pub struct TangentPlane<T> {
    /// Height of the point above the plane, along the normal [m].
    pub height: T,
    /// Normal and two tangents, in the base frame.
    pub directions: [Vec3<T>; 3],
}

impl<T: SimdFloat> LocalTerrain<'_, T> {
    /// Returns a lower bound on the height of every point within `radius` [m] of `centre`, a point of the base frame [m].
    #[inline(always)]
    pub fn lowest_within(&self, centre: Vec3<T>, radius: T) -> T {
        self.height + self.directions[0].dot(centre) - radius
    }

    /// Returns the tangent plane below a point of the base frame.
    #[inline(always)]
    pub fn plane_below(&self, point: Vec3<T>) -> TangentPlane<T> {
        match self.terrain {
            SimdTerrain::Plane(_) => {
                TangentPlane { height: self.height + self.directions[0].dot(point), directions: self.directions }
            }
            SimdTerrain::Field(field, _) => self.below_on_field(field, point),
        }
    }

    #[inline(always)]
    fn below_on_field(&self, field: &HeightField, point: Vec3<T>) -> TangentPlane<T> {
        let zero = T::splat(0.0);
        let [x, y, z] = (self.position + in_world(point, &self.axes)).0;
        let (mut ground, mut normal): (T, Vec3<T>) = (zero, Vec3::zero());
        for lane in 0..T::LANES {
            let (height, upward) = field.sample(x.get(lane) as f32, y.get(lane) as f32);
            ground.set(lane, f64::from(height));
            normal.set(lane, DVec3::from(upward.map(f64::from)));
        }
        // The second tangent is normal × x, normalised; its x component is zero.
        let [_, ny, nz] = normal.0;
        let size = (ny * ny + nz * nz).sqrt();
        let across = Vec3([zero, nz / size, -(ny / size)]);
        let directions =
            [to_base(normal, &self.axes), to_base(across.cross(normal), &self.axes), to_base(across, &self.axes)];
        TangentPlane { height: (z - ground) * nz, directions }
    }
}

/// Transforms a vector from the world frame to the base frame.
#[inline(always)]
fn to_base<T: SimdFloat>(world: Vec3<T>, axes: &[Vec3<T>; 3]) -> Vec3<T> {
    axes[0].scaled(world.0[0]) + axes[1].scaled(world.0[1]) + axes[2].scaled(world.0[2])
}

/// Transforms a vector from the base frame to the world frame.
#[inline(always)]
fn in_world<T: SimdFloat>(base: Vec3<T>, axes: &[Vec3<T>; 3]) -> Vec3<T> {
    Vec3([axes[0].dot(base), axes[1].dot(base), axes[2].dot(base)])
}
