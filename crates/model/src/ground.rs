//! Ground under the robots: a plane, or a height field.

use std::sync::Arc;

use glam::Vec3;

use crate::HeightField;

/// Half width of the height field in a rendered scene [m], and its limit in cells, which limits the data to 104 kB.
const RENDER_EXTENT: (f32, usize) = (8.0, 80);

/// Ground under the robots: a plane, or a height field.
#[derive(Clone, Debug, PartialEq)]
pub struct Ground {
    /// Point of the plane in the world frame [m].
    pub point: [f32; 3],
    /// Unit normal of the plane in the world frame.
    pub normal: [f32; 3],
    /// Height field of rough ground. It replaces the plane everywhere: outside the grid it has the heights of its edge.
    pub height_field: Option<Arc<HeightField>>,
    /// Patches of the height field on which robots start. Without them they start at the origin.
    pub patches: Option<Patches>,
}

/// Square patches in a grid: a level of difficulty for each row along x, a kind of ground for each column along y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patches {
    /// Corner of the first patch [m].
    pub origin: [f32; 2],
    /// Side length of a patch [m].
    pub side: f32,
    /// Number of levels.
    pub levels: usize,
    /// Number of kinds.
    pub columns: usize,
}

impl Patches {
    /// Returns the middle of a patch [m].
    pub fn centre(&self, level: usize, column: usize) -> [f32; 2] {
        [self.origin[0] + self.side * (level as f32 + 0.5), self.origin[1] + self.side * (column as f32 + 0.5)]
    }
}

impl Ground {
    /// The plane z = 0.
    pub const FLAT: Ground = Ground { point: [0.0; 3], normal: [0.0, 0.0, 1.0], height_field: None, patches: None };

    /// Returns the height of the ground at (`x`, `y`) [m].
    #[inline]
    pub fn height(&self, x: f32, y: f32) -> f32 {
        self.sample(x, y).0
    }

    /// Returns the height [m] and unit normal of the ground at (`x`, `y`) [m].
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 3]) {
        if let Some(field) = &self.height_field {
            return field.sample(x, y);
        }
        let [a, b, c] = self.normal;
        (self.point[2] - (a * (x - self.point[0]) + b * (y - self.point[1])) / c, self.normal)
    }

    /// Returns a height [m] of the centre of a sphere of `radius` [m] above (`x`, `y`) at which it has no contact.
    ///
    /// The least such height on a plane. On a height field an upper bound: it uses the largest slope near the sphere.
    pub fn clearance_height(&self, x: f32, y: f32, radius: f32) -> f32 {
        let (height, normal) = self.sample(x, y);
        match &self.height_field {
            None => height + radius / normal[2],
            Some(field) => height + radius * field.max_slope(x, y, radius).hypot(1.0),
        }
    }

    /// Returns the ground for rendering a robot at (`x`, `y`) [m]: a height field is cropped around the robot.
    pub fn crop(&self, x: f32, y: f32) -> Ground {
        let part = |field: &Arc<HeightField>| {
            let (reach, most) = RENDER_EXTENT;
            Arc::new(field.around(x, y, ((reach / field.cell_size()).ceil() as usize).min(most)))
        };
        Ground { height_field: self.height_field.as_ref().map(part), ..*self }
    }

    /// Returns the normal of the plane.
    pub fn up(&self) -> Vec3 {
        Vec3::from(self.normal)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn sphere_at_its_clearance_height_does_not_touch_the_height_field(seed: u64, x in -1.0f32..1.0, y in -1.0f32..1.0) {
            let field = HeightField::random_uniform(0.1, 0.05, 40, seed).expect("a field");
            let ground = Ground { height_field: Some(Arc::new(field)), ..Ground::FLAT };
            let radius = 0.05;
            let centre = ground.clearance_height(x, y, radius);
            for index in 0..400 {
                let (dx, dy) = ((index / 20) as f32 / 200.0 - 0.05, (index % 20) as f32 / 200.0 - 0.05);
                let distance = Vec3::new(dx, dy, ground.height(x + dx, y + dy) - centre).length();
                prop_assert!(distance > radius - 1e-5, "{distance}");
            }
        }

        #[test]
        fn height_of_a_plane_follows_its_equation(angle in -1.0f32..1.0, x in -5.0f32..5.0, y in -5.0f32..5.0) {
            let ground = Ground { normal: [-angle.sin(), 0.0, angle.cos()], ..Ground::FLAT };
            prop_assert!((ground.height(x, y) - x * angle.tan()).abs() < 1e-4);
            let centre = Vec3::new(x, y, ground.clearance_height(x, y, 0.1));
            prop_assert!((ground.up().dot(centre) - 0.1).abs() < 1e-5);
        }
    }
}
