//! What robots stand on: a plane, or a height field in it.

use std::sync::Arc;

use glam::Vec3;

use crate::HeightField;

/// The farthest that a picture shows a height field [m], and the most cells that it takes for that: 104 kB.
const RENDER_EXTENT: (f32, usize) = (8.0, 80);

/// The ground under the robots: a plane, with a height field in place of a part of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Ground {
    /// A point of the plane in the world [m].
    pub point: [f32; 3],
    /// The plane's unit normal in the world.
    pub normal: [f32; 3],
    /// Heights above z = 0, where the ground is rough. Robots never see the plane then: the field's edge goes on.
    pub height_field: Option<Arc<HeightField>>,
}

impl Ground {
    /// The plane z = 0.
    pub const FLAT: Ground = Ground { point: [0.0; 3], normal: [0.0, 0.0, 1.0], height_field: None };

    /// Height of the ground at (`x`, `y`) [m].
    #[inline]
    pub fn height(&self, x: f32, y: f32) -> f32 {
        self.sample(x, y).0
    }

    /// Height [m] and unit normal of the ground at (`x`, `y`) [m].
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 3]) {
        if let Some(field) = &self.height_field {
            return field.sample(x, y);
        }
        let [a, b, c] = self.normal;
        (self.point[2] - (a * (x - self.point[0]) + b * (y - self.point[1])) / c, self.normal)
    }

    /// Height [m] at which the centre of a ball of `radius` [m] above (`x`, `y`) touches nothing yet.
    ///
    /// Exact on a plane; on a height field it takes the steepest triangle near for all of them, and is never too low.
    pub fn clearance_height(&self, x: f32, y: f32, radius: f32) -> f32 {
        let (height, normal) = self.sample(x, y);
        match &self.height_field {
            None => height + radius / normal[2],
            Some(field) => height + radius * field.max_slope(x, y, radius).hypot(1.0),
        }
    }

    /// The ground for a picture of a robot at (`x`, `y`) [m]: of a height field only what is near.
    pub fn crop(&self, x: f32, y: f32) -> Ground {
        let part = |field: &Arc<HeightField>| {
            let (reach, most) = RENDER_EXTENT;
            Arc::new(field.around(x, y, ((reach / field.cell()).ceil() as usize).min(most)))
        };
        Ground { height_field: self.height_field.as_ref().map(part), ..*self }
    }

    /// Direction away from the ground as a whole: the plane's normal.
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
        fn ball_at_its_clear_height_touches_no_vertex_and_no_triangle(seed: u64, x in -1.0f32..1.0, y in -1.0f32..1.0) {
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
        fn plane_is_as_high_as_its_equation_says(angle in -1.0f32..1.0, x in -5.0f32..5.0, y in -5.0f32..5.0) {
            let ground = Ground { normal: [-angle.sin(), 0.0, angle.cos()], ..Ground::FLAT };
            prop_assert!((ground.height(x, y) - x * angle.tan()).abs() < 1e-4);
            let centre = Vec3::new(x, y, ground.clearance_height(x, y, 0.1));
            prop_assert!((ground.up().dot(centre) - 0.1).abs() < 1e-5);
        }
    }
}
