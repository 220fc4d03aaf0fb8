//! The ground of the batch engine: a plane, or a height field.

use glam::DVec3;
use twinstep_dynamics::{State, Vec3};
use twinstep_model::Ground;
use twinstep_simd::SimdFloat;

use super::field::ContactField;

/// Ground under robots in SIMD lanes.
#[derive(Clone, Debug)]
pub enum SimdTerrain<T> {
    /// A plane through the origin: its normal and two tangents, in the world frame.
    Plane([Vec3<T>; 3]),
    /// A height field.
    Field(ContactField),
}

impl<T: SimdFloat> SimdTerrain<T> {
    /// Converts the ground of a backend.
    pub fn new(ground: &Ground) -> Self {
        if let Some(field) = &ground.height_field {
            return Self::Field(ContactField::new(field.clone()));
        }
        let normal = DVec3::from(ground.normal.map(f64::from));
        let across = normal.cross(DVec3::X).normalize();
        Self::Plane([normal, across.cross(normal), across].map(Vec3::splat))
    }

    /// Returns how many contacts a point has at most: on a height field it may touch two faces.
    pub fn contacts_of_point(&self) -> usize {
        match self {
            Self::Plane(_) => 1,
            Self::Field(_) => MAX_CONTACTS,
        }
    }

    /// Returns the ground relative to the bases in this state.
    #[inline(always)]
    pub fn local_ground<J>(&self, state: &State<T, J>) -> LocalTerrain<'_, T> {
        let axes = state.world_axes();
        let velocity = to_base(state.linear_velocity, &axes);
        let shape = match self {
            Self::Plane(plane) => LocalShape::Plane {
                directions: [to_base(plane[0], &axes), to_base(plane[1], &axes), to_base(plane[2], &axes)],
                height: plane[0].dot(state.position),
            },
            Self::Field(field) => LocalShape::Field { field, position: state.position, axes },
        };
        LocalTerrain { shape, velocity }
    }
}

/// Largest number of contacts of a point.
const MAX_CONTACTS: usize = 2;

/// Ground relative to the base.
pub struct LocalTerrain<'a, T> {
    shape: LocalShape<'a, T>,
    /// Velocity of the base origin in the base frame [m/s].
    pub velocity: Vec3<T>,
}

enum LocalShape<'a, T> {
    Plane {
        /// Normal and two tangents, in the base frame.
        directions: [Vec3<T>; 3],
        /// Height of the base origin above the plane [m].
        height: T,
    },
    Field {
        field: &'a ContactField,
        /// Position of the base [m].
        position: Vec3<T>,
        /// Axes of the world in the base frame.
        axes: [Vec3<T>; 3],
    },
}

/// Tangent plane of the ground where a point is nearest to it.
#[derive(Clone, Copy)]
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
        match &self.shape {
            LocalShape::Plane { directions, height } => *height + directions[0].dot(centre) - radius,
            LocalShape::Field { field, position, axes } => {
                let [x, y, z] = (*position + in_world(centre, axes)).0;
                let mut highest = z;
                for lane in 0..T::LANES {
                    let bound = field.highest(x.get(lane) as f32, y.get(lane) as f32, radius.get(lane) as f32);
                    highest.set(lane, f64::from(bound));
                }
                z - highest - radius
            }
        }
    }

    /// Returns the tangent plane of each contact that a sphere about a point of the base frame may have. On a plane only the
    /// first one counts: see [`SimdTerrain::contacts_of_point`].
    #[inline(always)]
    pub fn contacts(&self, centre: Vec3<T>, radius: T) -> [TangentPlane<T>; MAX_CONTACTS] {
        match &self.shape {
            LocalShape::Plane { directions, height } => {
                [TangentPlane { height: *height + directions[0].dot(centre), directions: *directions }; MAX_CONTACTS]
            }
            LocalShape::Field { field, position, axes } => {
                contacts_with_field(field, *position + in_world(centre, axes), radius, axes)
            }
        }
    }
}

#[inline(always)]
fn contacts_with_field<T: SimdFloat>(
    field: &ContactField,
    centre: Vec3<T>,
    radius: T,
    axes: &[Vec3<T>; 3],
) -> [TangentPlane<T>; MAX_CONTACTS] {
    let ([x, y, z], up) = (centre.0, Vec3::splat(DVec3::Z));
    let (mut heights, mut normals) = ([z; MAX_CONTACTS], [up; MAX_CONTACTS]);
    for lane in 0..T::LANES {
        let centre = DVec3::new(x.get(lane), y.get(lane), z.get(lane)).as_vec3();
        for (contact, touch) in field.touches(centre, radius.get(lane) as f32).into_iter().enumerate() {
            heights[contact].set(lane, f64::from(touch.distance));
            normals[contact].set(lane, touch.normal.as_dvec3());
        }
    }
    [tangent_plane(heights[0], normals[0], axes), tangent_plane(heights[1], normals[1], axes)]
}

#[inline(always)]
fn tangent_plane<T: SimdFloat>(height: T, normal: Vec3<T>, axes: &[Vec3<T>; 3]) -> TangentPlane<T> {
    let [normal, along, across] = with_tangents(normal);
    TangentPlane { height, directions: [to_base(normal, axes), to_base(along, axes), to_base(across, axes)] }
}

/// Returns an upward normal and two tangents; x and y on level ground (Duff et al. 2017, equation 3).
#[inline(always)]
fn with_tangents<T: SimdFloat>(normal: Vec3<T>) -> [Vec3<T>; 3] {
    let ([x, y, z], one) = (normal.0, T::splat(1.0));
    let scale = one / (one + z);
    let mixed = -(x * y * scale);
    [normal, Vec3([one - x * x * scale, mixed, -x]), Vec3([mixed, one - y * y * scale, -y])]
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
