//! Collision shapes of the ground in rapier, built once and shared by all worlds.

use glam::{Quat, Vec3};
use rapier3d::parry::utils::Array2;
use rapier3d::prelude::*;
use twinstep_model::{Ground, HeightField};

/// Rotation from the axes of rapier's height field to the world.
///
/// Heights in rapier are along y, rows along z and columns along x. The rotation maps y to the world's z, z to x and
/// x to y. Rows, columns and the diagonals of the cells then are those of [`HeightField`].
const WORLD_FROM_FIELD: Quat = Quat::from_xyzw(0.5, 0.5, 0.5, 0.5);
/// Width [m] and thickness [m] of the slabs around a height field.
const SURROUNDINGS: (f32, f32) = (1000.0, 10.0);

/// Shapes of the ground and their poses. Clones share the shapes.
#[derive(Clone)]
pub struct GroundShapes(Vec<(Pose, SharedShape)>);

impl GroundShapes {
    /// Creates the shapes of `ground`: a half space, or a height field surrounded by level ground at height 0.
    pub fn new(ground: &Ground) -> Self {
        Self(match &ground.height_field {
            None => {
                let pose = Pose::from_parts(Vec3::from(ground.point), Quat::IDENTITY);
                vec![(pose, SharedShape::halfspace(ground.up()))]
            }
            Some(field) => [vec![surface(field)], surroundings(field).to_vec()].concat(),
        })
    }

    /// Returns one collider per shape.
    pub fn colliders(&self) -> impl Iterator<Item = ColliderBuilder> {
        self.0.iter().map(|(pose, shape)| ColliderBuilder::new(shape.clone()).position(*pose))
    }
}

/// Returns the extent of a height field along x and y [m].
fn extent(field: &HeightField) -> [f32; 2] {
    field.shape().map(|count| field.cell_size() * (count - 1) as f32)
}

/// Returns the centre of a height field at height 0 [m].
fn centre(field: &HeightField) -> Vec3 {
    let ([x, y], [along_x, along_y]) = (field.origin(), extent(field));
    Vec3::new(x + 0.5 * along_x, y + 0.5 * along_y, 0.0)
}

fn surface(field: &HeightField) -> (Pose, SharedShape) {
    let ([rows, columns], [along_x, along_y]) = (field.shape(), extent(field));
    let heights = Array2::from_fn(rows, columns, |row, column| field.heights()[row * columns + column]);
    // The flag limits contact normals to those between neighbouring triangles. This avoids spurious contacts at inner
    // edges and downward normals from below.
    let flags = HeightFieldFlags::FIX_INTERNAL_EDGES;
    let shape = SharedShape::heightfield_with_flags(heights, Vec3::new(along_y, 1.0, along_x), flags);
    (Pose::from_parts(centre(field), WORLD_FROM_FIELD), shape)
}

/// Returns four slabs around a height field, level with its border.
fn surroundings(field: &HeightField) -> [(Pose, SharedShape); 4] {
    let (width, thickness) = SURROUNDINGS;
    let half = extent(field).map(|length| 0.5 * length);
    let slab = |offset: Vec3, half_x: f32, half_y: f32| {
        let position = centre(field) + offset - Vec3::new(0.0, 0.0, 0.5 * thickness);
        (Pose::from_parts(position, Quat::IDENTITY), SharedShape::cuboid(half_x, half_y, 0.5 * thickness))
    };
    let along_x = Vec3::new(half[0] + 0.5 * width, 0.0, 0.0);
    let along_y = Vec3::new(0.0, half[1] + 0.5 * width, 0.0);
    let wide = half[0] + width;
    [
        slab(along_x, 0.5 * width, half[1]),
        slab(-along_x, 0.5 * width, half[1]),
        slab(along_y, wide, 0.5 * width),
        slab(-along_y, wide, 0.5 * width),
    ]
}

#[cfg(test)]
mod tests {
    use rapier3d::parry::query::Ray;

    use super::*;

    #[test]
    fn rays_from_above_hit_the_height_field() {
        let field = HeightField::random_uniform(0.3, 0.25, 40, 3).expect("a field");
        let shapes = GroundShapes::new(&Ground { height_field: Some(field.clone().into()), ..Ground::FLAT });
        for index in 0..2000 {
            // Irrational steps cover the height field (±5 m) and the 2 m around it.
            let [x, y] = [0.618_034, 0.754_878].map(|step| 14.0 * (index as f32 * step).fract() - 7.0);
            let ray = Ray::new(Vec3::new(x, y, 2.0), Vec3::NEG_Z);
            let hits =
                shapes.0.iter().filter_map(|(pose, shape)| shape.cast_ray_and_get_normal(pose, &ray, 10.0, true));
            let hit = hits.min_by(|a, b| a.time_of_impact.total_cmp(&b.time_of_impact)).expect("there is ground");
            let (height, normal) = field.sample(x, y);
            assert!((2.0 - hit.time_of_impact - height).abs() < 1e-5, "({x}, {y}): {height}");
            // At an edge the normal of either triangle is correct.
            let candidates = [-1e-4, 0.0, 1e-4].map(|d| Vec3::from(field.normal(x + d, y + d)));
            let same = candidates.iter().any(|normal| (hit.normal - normal).length() < 1e-4);
            assert!(same, "({x}, {y}): {:?}, expected {normal:?}", hit.normal);
        }
    }
}
