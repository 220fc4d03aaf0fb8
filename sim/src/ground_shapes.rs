//! The ground as rapier has it: built once, shared by all worlds.

use glam::{Quat, Vec3};
use rapier3d::parry::utils::Array2;
use rapier3d::prelude::*;
use twinstep_model::{Ground, HeightField};

/// rapier's height fields rise along y, with rows along z and columns along x. This turns y to the world's z, z to x and
/// x to y, so that rows and columns are ours and the cells are cut along the same diagonal.
const WORLD_FROM_FIELD: Quat = Quat::from_xyzw(0.5, 0.5, 0.5, 0.5);
/// How far the level ground around a height field reaches [m], and how thick it is [m].
const SURROUNDINGS: (f32, f32) = (1000.0, 10.0);

/// Shapes of the ground and where they are. Clones share the shapes.
#[derive(Clone)]
pub struct GroundShapes(Vec<(Pose, SharedShape)>);

impl GroundShapes {
    /// The shapes of `ground`: a half space, or a height field with level ground at height 0 around it.
    pub fn new(ground: &Ground) -> Self {
        Self(match &ground.height_field {
            None => {
                let pose = Pose::from_parts(Vec3::from(ground.point), Quat::IDENTITY);
                vec![(pose, SharedShape::halfspace(ground.up()))]
            }
            Some(field) => [vec![surface(field)], surroundings(field).to_vec()].concat(),
        })
    }

    /// A collider for each shape.
    pub fn colliders(&self) -> impl Iterator<Item = ColliderBuilder> {
        self.0.iter().map(|(pose, shape)| ColliderBuilder::new(shape.clone()).position(*pose))
    }
}

/// Extent of a field along x and y [m].
fn extent(field: &HeightField) -> [f32; 2] {
    field.shape().map(|count| field.cell() * (count - 1) as f32)
}

/// Centre of a field at height 0 [m].
fn centre(field: &HeightField) -> Vec3 {
    let ([x, y], [along_x, along_y]) = (field.corner(), extent(field));
    Vec3::new(x + 0.5 * along_x, y + 0.5 * along_y, 0.0)
}

fn surface(field: &HeightField) -> (Pose, SharedShape) {
    let ([rows, columns], [along_x, along_y]) = (field.shape(), extent(field));
    let heights = Array2::from_fn(rows, columns, |row, column| field.heights()[row * columns + column]);
    // Neighbouring triangles limit each other's normals: no bumps at inner edges, and nothing is pushed down from below.
    let flags = HeightFieldFlags::FIX_INTERNAL_EDGES;
    let shape = SharedShape::heightfield_with_flags(heights, Vec3::new(along_y, 1.0, along_x), flags);
    (Pose::from_parts(centre(field), WORLD_FROM_FIELD), shape)
}

/// Four slabs around a field, level with its rim.
fn surroundings(field: &HeightField) -> [(Pose, SharedShape); 4] {
    let (reach, thickness) = SURROUNDINGS;
    let half = extent(field).map(|length| 0.5 * length);
    let slab = |offset: Vec3, half_x: f32, half_y: f32| {
        let position = centre(field) + offset - Vec3::new(0.0, 0.0, 0.5 * thickness);
        (Pose::from_parts(position, Quat::IDENTITY), SharedShape::cuboid(half_x, half_y, 0.5 * thickness))
    };
    let aside = Vec3::new(half[0] + 0.5 * reach, 0.0, 0.0);
    let ahead = Vec3::new(0.0, half[1] + 0.5 * reach, 0.0);
    let wide = half[0] + reach;
    [
        slab(aside, 0.5 * reach, half[1]),
        slab(-aside, 0.5 * reach, half[1]),
        slab(ahead, wide, 0.5 * reach),
        slab(-ahead, wide, 0.5 * reach),
    ]
}

#[cfg(test)]
mod tests {
    use rapier3d::parry::query::Ray;

    use super::*;

    #[test]
    fn rays_from_above_meet_the_surface_where_the_field_has_it() {
        let field = HeightField::random_uniform(0.3, 0.25, 40, 3).expect("a field");
        let shapes = GroundShapes::new(&Ground { height_field: Some(field.clone().into()), ..Ground::FLAT });
        for index in 0..2000 {
            // Irrational steps go everywhere: over the field (±5 m) and 2 m around it.
            let [x, y] = [0.618_034, 0.754_878].map(|step| 14.0 * (index as f32 * step).fract() - 7.0);
            let ray = Ray::new(Vec3::new(x, y, 2.0), Vec3::NEG_Z);
            let hits =
                shapes.0.iter().filter_map(|(pose, shape)| shape.cast_ray_and_get_normal(pose, &ray, 10.0, true));
            let hit = hits.min_by(|a, b| a.time_of_impact.total_cmp(&b.time_of_impact)).expect("there is ground");
            let (height, normal) = field.sample(x, y);
            assert!((2.0 - hit.time_of_impact - height).abs() < 1e-5, "({x}, {y}): {height}");
            // At an edge either triangle is right.
            let near = [-1e-4, 0.0, 1e-4].map(|d| Vec3::from(field.normal(x + d, y + d)));
            let same = near.iter().any(|normal| (hit.normal - normal).length() < 1e-4);
            assert!(same, "({x}, {y}): {:?}, the field has {normal:?}", hit.normal);
        }
    }
}
