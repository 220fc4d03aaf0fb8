//! Where a sphere touches a height field.
//!
//! A sphere touches the nearest point of the surface, with the normal from there to its centre. In a valley, or at the foot
//! of a step, it rests on a second face, too. So a step is as high as it is, and a sphere beside its face is pushed away
//! from the face, not up.

use std::sync::Arc;

use glam::Vec3;
use twinstep_model::HeightField;

/// Largest cosine between the normals of two faces that a sphere touches at once.
const MAX_COSINE: f32 = 0.95;
/// Distance below which the direction to the surface is not known, and its own normal counts [m].
const AT_SURFACE: f32 = 1e-4;
/// Depth of a centre below the surface up to which the nearest point of the surface is the way out [m].
const DEPTH: f32 = 0.03;
/// Width of the blocks that hold the extreme heights near a point, and near a body [m].
const BLOCK_WIDTHS: [f32; 2] = [0.05, 0.5];

/// Contact of a sphere with a height field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Touch {
    /// Distance of the sphere's centre from the surface; negative below it [m].
    pub distance: f32,
    /// Unit normal of the surface.
    pub normal: Vec3,
}

impl Touch {
    /// No contact: farther than any sphere is large. It is finite because a lane without contact is computed, too.
    pub const NONE: Touch = Touch { distance: 1e3, normal: Vec3::Z };
}

/// Height field with what the search for contacts needs.
#[derive(Clone, Debug)]
pub struct ContactField {
    field: Arc<HeightField>,
    near_points: Blocks,
    near_bodies: Blocks,
}

/// Lowest and highest heights in square blocks of a height field.
#[derive(Clone, Debug)]
struct Blocks {
    origin: [f32; 2],
    width: f32,
    shape: [usize; 2],
    extremes: Vec<[f32; 2]>,
}

impl ContactField {
    /// Prepares a height field.
    pub fn new(field: Arc<HeightField>) -> Self {
        let [near_points, near_bodies] = BLOCK_WIDTHS.map(|width| Blocks::new(&field, width));
        Self { field, near_points, near_bodies }
    }

    /// Returns the greatest height within `reach` [m] of (`x`, `y`) [m] along either axis, or a greater one.
    pub fn highest(&self, x: f32, y: f32, reach: f32) -> f32 {
        self.near_bodies.extremes(x, y, reach)[1]
    }

    /// Returns the contacts of a sphere: with the nearest point of the surface, and with a second face. The one whose normal
    /// is closer to the vertical comes first.
    #[inline]
    pub fn touches(&self, centre: Vec3, radius: f32) -> [Touch; 2] {
        let [lowest, highest] = self.near_points.extremes(centre.x, centre.y, radius);
        if centre.z - radius > highest {
            return [Touch::NONE; 2];
        }
        if lowest == highest {
            return [Touch { distance: centre.z - highest, normal: Vec3::Z }, Touch::NONE];
        }
        self.nearest(centre, radius)
    }

    fn nearest(&self, centre: Vec3, radius: f32) -> [Touch; 2] {
        let (height, normal) = self.field.sample(centre.x, centre.y);
        let (normal, above) = (Vec3::from(normal), centre.z - height);
        let is_outside = above >= 0.0;
        let reach = if is_outside { radius } else { radius.max(DEPTH) };
        let mut nearest = Touch { distance: reach, normal: Vec3::ZERO };
        self.for_each_triangle(centre, reach, |corners| {
            let (point, _) = nearest_point(corners);
            let distance = point.length();
            if distance < nearest.distance {
                let away = if distance > AT_SURFACE { -point / distance } else { upward_normal(corners) };
                nearest = Touch { distance, normal: away };
            }
        });
        if !is_outside {
            // Deeper than this, the way out is up.
            let vertical = Touch { distance: above * normal.z, normal };
            let out = Touch { distance: -nearest.distance, normal: -nearest.normal };
            let is_known = nearest.normal != Vec3::ZERO && nearest.distance > AT_SURFACE;
            return [if is_known { out } else { vertical }, Touch::NONE];
        }
        if nearest.normal == Vec3::ZERO {
            return [Touch::NONE; 2];
        }
        let second = self.second_face(centre, radius, nearest.normal);
        if second.normal.z > nearest.normal.z && second.distance < radius {
            [second, nearest]
        } else {
            [nearest, second]
        }
    }

    /// Returns the contact with the nearest face that is turned away from `first`, a normal.
    fn second_face(&self, centre: Vec3, radius: f32, first: Vec3) -> Touch {
        let mut second = Touch::NONE;
        self.for_each_triangle(centre, radius, |corners| {
            let normal = upward_normal(corners);
            if normal.dot(first) < MAX_COSINE {
                let (point, is_in_face) = nearest_point(corners);
                let distance = point.length();
                if is_in_face && point.dot(normal) < 0.0 && distance < radius.min(second.distance) {
                    second = Touch { distance, normal };
                }
            }
        });
        second
    }

    /// Calls `visit` with the corners, relative to `centre`, of each triangle that may be within `reach` [m].
    fn for_each_triangle(&self, centre: Vec3, reach: f32, mut visit: impl FnMut([Vec3; 3])) {
        let (field, cell) = (&self.field, self.field.cell_size());
        let ([rows, columns], [x, y]) = (field.shape(), field.origin());
        // Outside the grid the surface continues from its edge, so far-away spheres are like those beside the edge.
        let position = |at: f32, origin: f32, count: usize| {
            let margin = reach + 2.0 * cell;
            (at - origin).clamp(-margin, cell * (count - 1) as f32 + margin)
        };
        let [along_x, along_y] = [position(centre.x, x, rows), position(centre.y, y, columns)];
        let range = |at: f32| [at - reach, at + reach].map(|at| (at / cell).floor() as i32);
        let ([first_row, last_row], [first_column, last_column]) = (range(along_x), range(along_y));
        let corner = |row: i32, column: i32| {
            let index = |at: i32, count: usize| at.clamp(0, count as i32 - 1) as usize;
            let height = field.heights()[index(row, rows) * columns + index(column, columns)];
            Vec3::new(row as f32 * cell - along_x, column as f32 * cell - along_y, height - centre.z)
        };
        for row in first_row..=last_row {
            for column in first_column..=last_column {
                let [near, far] = [corner(row, column), corner(row + 1, column + 1)];
                let [far_x, far_y] = [corner(row + 1, column), corner(row, column + 1)];
                if near.z.max(far.z).max(far_x.z).max(far_y.z) >= -reach {
                    visit([near, far_x, far_y]);
                    visit([far, far_y, far_x]);
                }
            }
        }
    }
}

impl Blocks {
    fn new(field: &HeightField, width: f32) -> Self {
        let cells = (width / field.cell_size()).round().max(1.0) as usize;
        let [rows, columns] = field.shape();
        let shape = [(rows - 1).div_ceil(cells), (columns - 1).div_ceil(cells)];
        let extremes_of = |block: usize| {
            let [first_row, first_column] = [block / shape[1] * cells, block % shape[1] * cells];
            let [last_row, last_column] = [(first_row + cells).min(rows - 1), (first_column + cells).min(columns - 1)];
            let of_rows =
                (first_row..=last_row).flat_map(|row| &field.heights()[row * columns..][first_column..=last_column]);
            of_rows
                .fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], height| [low.min(*height), high.max(*height)])
        };
        let extremes = (0..shape[0] * shape[1]).map(extremes_of).collect();
        Self { origin: field.origin(), width: cells as f32 * field.cell_size(), shape, extremes }
    }

    /// Returns the extreme heights of the blocks within `reach` [m] of (`x`, `y`) [m] along either axis.
    #[inline]
    fn extremes(&self, x: f32, y: f32, reach: f32) -> [f32; 2] {
        let range = |at: f32, origin: f32, count: usize| {
            let block = |at: f32| ((at - origin) / self.width).clamp(0.0, (count - 1) as f32) as usize;
            block(at - reach)..=block(at + reach)
        };
        let [mut lowest, mut highest] = [f32::INFINITY, f32::NEG_INFINITY];
        for row in range(x, self.origin[0], self.shape[0]) {
            for column in range(y, self.origin[1], self.shape[1]) {
                let [low, high] = self.extremes[row * self.shape[1] + column];
                (lowest, highest) = (lowest.min(low), highest.max(high));
            }
        }
        [lowest, highest]
    }
}

/// Returns the unit normal of a triangle of the surface.
fn upward_normal([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a).normalize()
}

/// Returns the point of a triangle that is nearest to the origin, and whether it is within the triangle, not on its edge.
///
/// Ericson, Real-Time Collision Detection, section 5.1.5.
fn nearest_point([a, b, c]: [Vec3; 3]) -> (Vec3, bool) {
    let (ab, ac) = (b - a, c - a);
    let (d1, d2) = (-ab.dot(a), -ac.dot(a));
    if d1 <= 0.0 && d2 <= 0.0 {
        return (a, false);
    }
    let (d3, d4) = (-ab.dot(b), -ac.dot(b));
    if d3 >= 0.0 && d4 <= d3 {
        return (b, false);
    }
    let of_c = d1 * d4 - d3 * d2;
    if of_c <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return (a + ab * (d1 / (d1 - d3)), false);
    }
    let (d5, d6) = (-ab.dot(c), -ac.dot(c));
    if d6 >= 0.0 && d5 <= d6 {
        return (c, false);
    }
    let of_b = d5 * d2 - d1 * d6;
    if of_b <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return (a + ac * (d2 / (d2 - d6)), false);
    }
    let of_a = d3 * d6 - d5 * d4;
    if of_a <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return (b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6))), false);
    }
    let sum = of_a + of_b + of_c;
    (a + ab * (of_b / sum) + ac * (of_c / sum), true)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RADIUS: f32 = 0.022;
    const CELL: f32 = 0.02;

    /// A step of `height` [m] whose face is between x = 0 and x = 0.02 m.
    fn step(height: f32) -> ContactField {
        let heights = (0..51 * 51).map(|index| if index / 51 > 25 { height } else { 0.0 }).collect();
        ContactField::new(Arc::new(HeightField::centred(CELL, [51, 51], heights).expect("a field")))
    }

    #[test]
    fn sphere_rests_on_a_step_at_the_height_of_the_step() {
        for height in [0.03, 0.08, 0.2] {
            for x in [0.02, 0.03, 0.1] {
                let [touch, none] = step(height).touches(Vec3::new(x, 0.003, height + 0.02), RADIUS);
                assert!((touch.distance - 0.02).abs() < 1e-6, "{height} m, x = {x}: {touch:?}");
                assert!(touch.normal.z > 0.99 && none == Touch::NONE, "{height} m, x = {x}: {touch:?}");
            }
        }
    }

    #[test]
    fn sphere_before_a_step_touches_the_floor_and_the_face() {
        for height in [0.08f32, 0.2] {
            let steep = Vec3::new(-height, 0.0, CELL).normalize();
            // 2 cm above the floor, and 2 cm from the face.
            let x = (0.02 * steep.z - 0.02) / -steep.x;
            let [floor, face] = step(height).touches(Vec3::new(x, 0.003, 0.02), RADIUS);
            assert!((floor.distance - 0.02).abs() < 1e-6 && floor.normal.z > 1.0 - 1e-6, "{floor:?}");
            assert!((face.distance - 0.02).abs() < 1e-5 && (face.normal - steep).length() < 1e-4, "{face:?}");
        }
    }

    #[test]
    fn sphere_beside_a_face_is_pushed_off_and_not_up() {
        let [touch, _] = step(0.2).touches(Vec3::new(-0.01, 0.0, 0.1), RADIUS);
        assert!(touch.distance > 0.0 && touch.normal.x < -0.99, "{touch:?}");
        let [inside, _] = step(0.2).touches(Vec3::new(0.016, 0.0, 0.1), RADIUS);
        assert!(inside.distance < 0.0 && inside.normal.x < -0.99, "{inside:?}");
    }

    #[test]
    fn sphere_at_an_edge_touches_it_obliquely() {
        let [touch, none] = step(0.1).touches(Vec3::new(0.01, 0.004, 0.112), RADIUS);
        let expected = Vec3::new(-0.01, 0.0, 0.012);
        assert!((touch.distance - expected.length()).abs() < 1e-6, "{touch:?}");
        assert!((touch.normal - expected.normalize()).length() < 1e-4 && none == Touch::NONE, "{touch:?}");
    }

    /// The corners of a trunk have no radius, so they are at the surface when they touch it.
    #[test]
    fn point_at_the_surface_is_pushed_up_and_never_into_the_ground() {
        let field = step(0.2);
        for x in [-0.03, -0.3, 0.03, 0.3, 0.01] {
            let height = field.field.height(x, 0.003);
            for depth in [1e-7, 1e-6, 1e-5, 5e-5, 2e-4] {
                for radius in [0.0, RADIUS] {
                    let [touch, _] = field.touches(Vec3::new(x, 0.003, height - depth), radius);
                    assert!(touch.distance <= 0.0 && touch.distance > -1e-3, "x = {x}, {depth} m deep: {touch:?}");
                    assert!(touch.normal.z > 0.0, "x = {x}, {depth} m deep: {touch:?}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn distance_is_that_of_the_nearest_point_of_the_surface(seed: u64, x in -1.2f32..1.2, y in -1.2f32..1.2, up in -0.02f32..0.06) {
            let field = HeightField::random_uniform(0.1, 0.05, 40, seed).expect("a field");
            let centre = Vec3::new(x, y, field.height(x, y) + up);
            let [one, other] = ContactField::new(Arc::new(field.clone())).touches(centre, 0.05);
            let found = one.distance.min(other.distance);
            let mut least = f32::INFINITY;
            for index in 0..=160 * 160 {
                let [dx, dy] = [index / 160, index % 160].map(|at| (at as f32 - 80.0) / 1600.0);
                least = least.min(Vec3::new(dx, dy, field.height(x + dx, y + dy) - centre.z).length());
            }
            if least < 0.045 {
                prop_assert!((found.abs() - least).abs() < 1e-3, "{found} instead of {least}");
                prop_assert!((found < 0.0) == (up < 0.0), "{found}, {up} m above");
            }
            for touch in [one, other] {
                prop_assert!((touch.normal.length() - 1.0).abs() < 1e-4, "{touch:?}");
                prop_assert!(touch.normal.z > -1e-3, "{touch:?}");
            }
        }

        #[test]
        fn blocks_bound_the_heights_near_a_point(seed: u64, x in -1.5f32..1.5, y in -1.5f32..1.5, dx in -0.3f32..0.3, dy in -0.3f32..0.3) {
            let field = HeightField::random_uniform(0.1, 0.03, 61, seed).expect("a field");
            let prepared = ContactField::new(Arc::new(field.clone()));
            prop_assert!(prepared.highest(x, y, 0.3) >= field.height(x + dx, y + dy));
        }
    }
}
