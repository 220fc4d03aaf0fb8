//! Ground as heights on a grid, with two triangles a cell.

use rand::RngExt;

use crate::stream;

/// Heights on a grid of square cells, each cut in two triangles along the diagonal from its far-x to its far-y corner.
///
/// Vertex (`row`, `column`) stands at `corner + cell · (row, column)`: rows go along x, columns along y. Outside the
/// grid the heights of its edge go on.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightField {
    corner: [f32; 2],
    cell: f32,
    /// 1 / `cell`.
    inv_cell_size: f32,
    rows: usize,
    columns: usize,
    heights: Vec<f32>,
}

/// Why a grid is no height field.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum HeightFieldError {
    /// A cell needs four corners.
    #[error("a height field has at least 2 rows and 2 columns; {rows} and {columns} were given")]
    TooSmall {
        /// Rows that were given.
        rows: usize,
        /// Columns that were given.
        columns: usize,
    },
    /// The number of heights does not fit.
    #[error("`heights` has {given} entries; {rows} rows and {columns} columns have {}", rows.saturating_mul(*columns))]
    WrongLength {
        /// Heights that were given.
        given: usize,
        /// Rows that were given.
        rows: usize,
        /// Columns that were given.
        columns: usize,
    },
    /// A height or the corner is not a number.
    #[error("`{0}` is not finite")]
    NotFinite(&'static str),
    /// Cells have no size.
    #[error("`cell` = {0} m is not allowed: 0.001 to 1000 m")]
    Cell(f32),
}

impl HeightField {
    /// A field of `rows` × `columns` heights [m], row by row, whose vertex (0, 0) stands at `corner` [m].
    ///
    /// `cell` is the distance between neighbours [m].
    pub fn new(
        corner: [f32; 2],
        cell: f32,
        [rows, columns]: [usize; 2],
        heights: Vec<f32>,
    ) -> Result<Self, HeightFieldError> {
        if rows < 2 || columns < 2 {
            return Err(HeightFieldError::TooSmall { rows, columns });
        }
        if rows.checked_mul(columns) != Some(heights.len()) {
            return Err(HeightFieldError::WrongLength { given: heights.len(), rows, columns });
        }
        if !(1e-3..=1e3).contains(&cell) {
            return Err(HeightFieldError::Cell(cell));
        }
        for (name, values) in [("corner", corner.as_slice()), ("heights", &heights)] {
            if values.iter().any(|value| !value.is_finite()) {
                return Err(HeightFieldError::NotFinite(name));
            }
        }
        Ok(Self { corner, cell, inv_cell_size: 1.0 / cell, rows, columns, heights })
    }

    /// As [`HeightField::new`], with the grid's centre at the origin.
    pub fn centred(cell: f32, shape: [usize; 2], heights: Vec<f32>) -> Result<Self, HeightFieldError> {
        Self::new(shape.map(|count| -0.5 * cell * (count as f32 - 1.0)), cell, shape, heights)
    }

    /// A square of `cells` × `cells` around the origin, with heights drawn evenly from 0 to `height` [m].
    ///
    /// The rim is at height 0, so that the field ends level with a plane around it.
    pub fn random_uniform(height: f32, cell: f32, cells: usize, seed: u64) -> Result<Self, HeightFieldError> {
        let mut stream = stream(seed, "rough", 0);
        let mut heights = Vec::with_capacity((cells + 1) * (cells + 1));
        for row in 0..=cells {
            for column in 0..=cells {
                let drawn = height * stream.random::<f32>();
                let on_rim = row % cells.max(1) == 0 || column % cells.max(1) == 0;
                heights.push(if on_rim { 0.0 } else { drawn });
            }
        }
        Self::centred(cell, [cells + 1; 2], heights)
    }

    /// Where vertex (0, 0) stands [m].
    pub fn corner(&self) -> [f32; 2] {
        self.corner
    }

    /// Distance between neighbouring vertices [m].
    pub fn cell(&self) -> f32 {
        self.cell
    }

    /// Number of vertices along x and along y.
    pub fn shape(&self) -> [usize; 2] {
        [self.rows, self.columns]
    }

    /// Height of every vertex [m], row by row.
    pub fn heights(&self) -> &[f32] {
        &self.heights
    }

    /// Height of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn height(&self, x: f32, y: f32) -> f32 {
        self.height_and_slope(x, y).0
    }

    /// Unit normal of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn normal(&self, x: f32, y: f32) -> [f32; 3] {
        self.sample(x, y).1
    }

    /// Height [m] and unit normal of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 3]) {
        let (height, [slope_x, slope_y]) = self.height_and_slope(x, y);
        let up = 1.0 / (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt();
        (height, [-slope_x * up, -slope_y * up, up])
    }

    /// Height [m] and its derivatives by x and y at (`x`, `y`) [m].
    #[inline]
    pub fn height_and_slope(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let (row, u, inside_x) = locate((x - self.corner[0]) * self.inv_cell_size, self.rows);
        let (column, v, inside_y) = locate((y - self.corner[1]) * self.inv_cell_size, self.columns);
        let [near, far_x, far_y, far] = self.cell_heights(row, column);
        // Both triangles have the vertices `far_x` and `far_y`; the third one is `near` or `far`.
        let nearer = u + v <= 1.0;
        let (base, a, b) = if nearer { (near, u, v) } else { (far, u - 1.0, v - 1.0) };
        let rise_x = if nearer { far_x - near } else { far - far_y };
        let rise_y = if nearer { far_y - near } else { far - far_x };
        let slope = [rise_x * self.inv_cell_size * inside_x, rise_y * self.inv_cell_size * inside_y];
        (base + a * rise_x + b * rise_y, slope)
    }

    /// Heights [m] of a cell's corners: its own vertex, the next along x, the next along y, the one across.
    #[inline]
    fn cell_heights(&self, row: usize, column: usize) -> [f32; 4] {
        let first = row * self.columns + column;
        let second = first + self.columns;
        [self.heights[first], self.heights[second], self.heights[first + 1], self.heights[second + 1]]
    }

    /// The greatest slope (rise over run) of the cells that come within `radius` [m] of (`x`, `y`) along either axis.
    pub fn max_slope(&self, x: f32, y: f32, radius: f32) -> f32 {
        let range = |value: f32, corner: f32, count: usize| {
            let cell = |value: f32| locate((value - corner) * self.inv_cell_size, count).0;
            cell(value - radius)..=cell(value + radius)
        };
        let mut steepest = 0.0f32;
        for row in range(x, self.corner[0], self.rows) {
            for column in range(y, self.corner[1], self.columns) {
                let [near, far_x, far_y, far] = self.cell_heights(row, column);
                let lower = (far_x - near).hypot(far_y - near);
                let upper = (far - far_y).hypot(far - far_x);
                steepest = steepest.max(lower).max(upper);
            }
        }
        steepest * self.inv_cell_size
    }

    /// The part within `cells` cells of (`x`, `y`) [m] along either axis, with at least one cell.
    pub fn around(&self, x: f32, y: f32, cells: usize) -> HeightField {
        let range = |value: f32, corner: f32, count: usize| {
            let (middle, ..) = locate((value - corner) * self.inv_cell_size, count);
            (middle.saturating_sub(cells), (middle + 1 + cells).min(count - 1))
        };
        let (first_row, last_row) = range(x, self.corner[0], self.rows);
        let (first_column, last_column) = range(y, self.corner[1], self.columns);
        let rows = self.heights.chunks_exact(self.columns).take(last_row + 1).skip(first_row);
        let first = [first_row, first_column];
        Self {
            corner: std::array::from_fn(|axis| self.corner[axis] + self.cell * first[axis] as f32),
            rows: last_row + 1 - first_row,
            columns: last_column + 1 - first_column,
            heights: rows.flat_map(|row| &row[first_column..=last_column]).copied().collect(),
            ..*self
        }
    }
}

/// The cell of `at` (in cells from the first vertex), the place in it from 0 to 1, and 1 inside the grid or 0 outside.
#[inline]
fn locate(at: f32, count: usize) -> (usize, f32, f32) {
    let clamped = at.max(0.0).min((count - 1) as f32);
    let cell = (clamped as usize).min(count - 2);
    (cell, clamped - cell as f32, f32::from(u8::from(at == clamped)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SHAPE: [usize; 2] = [7, 5];
    const CELL: f32 = 0.25;

    fn field(height: impl Fn(f32, f32) -> f32) -> HeightField {
        let corner = [-0.75, -0.5];
        let at = |index: usize, axis: usize| corner[axis] + CELL * index as f32;
        let heights =
            (0..SHAPE[0] * SHAPE[1]).map(|index| height(at(index / SHAPE[1], 0), at(index % SHAPE[1], 1))).collect();
        HeightField::centred(CELL, SHAPE, heights).expect("a field")
    }

    fn any_field() -> impl Strategy<Value = HeightField> {
        proptest::collection::vec(0.0f32..0.3, SHAPE[0] * SHAPE[1])
            .prop_map(|heights| HeightField::centred(CELL, SHAPE, heights).expect("a field"))
    }

    proptest! {
        #[test]
        fn heights_on_a_plane_are_that_plane(a in -1.0f32..1.0, b in -1.0f32..1.0, c in -1.0f32..1.0,
            x in -0.75f32..0.75, y in -0.5f32..0.5) {
            let (height, normal) = field(|x, y| a * x + b * y + c).sample(x, y);
            prop_assert!((height - (a * x + b * y + c)).abs() < 1e-5);
            let length = (1.0 + a * a + b * b).sqrt();
            for (found, wanted) in normal.iter().zip([-a / length, -b / length, 1.0 / length]) {
                prop_assert!((found - wanted).abs() < 1e-5);
            }
        }

        #[test]
        fn surface_has_no_steps(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75,
            dx in -1e-3f32..1e-3, dy in -1e-3f32..1e-3) {
            // The steepest triangle of heights within 0.3 m rises by 0.3 m in a cell, along x and along y.
            let bound = 0.3 / CELL * (dx.abs() + dy.abs()) + 1e-6;
            prop_assert!((field.height(x + dx, y + dy) - field.height(x, y)).abs() <= bound);
        }

        #[test]
        fn a_vertex_is_as_high_as_was_given(field in any_field(), row in 0..SHAPE[0], column in 0..SHAPE[1]) {
            let [x, y] = [-0.75 + CELL * row as f32, -0.5 + CELL * column as f32];
            prop_assert!((field.height(x, y) - field.heights()[row * SHAPE[1] + column]).abs() < 1e-6);
        }

        #[test]
        fn normal_is_the_surfaces(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75) {
            let normal = field.normal(x, y);
            prop_assert!((normal.iter().map(|value| value * value).sum::<f32>() - 1.0).abs() < 1e-5);
            let step = 1e-3;
            let same = [(-step, -step), (-step, step), (step, -step), (step, step)]
                .iter()
                .all(|(dx, dy)| field.normal(x + dx, y + dy) == normal);
            prop_assume!(same);
            let by_x = (field.height(x + step, y) - field.height(x - step, y)) / (2.0 * step);
            let by_y = (field.height(x, y + step) - field.height(x, y - step)) / (2.0 * step);
            // Heights have seven digits, and the step keeps four of them.
            prop_assert!((normal[0] / normal[2] + by_x).abs() < 1e-3, "{normal:?} {by_x}");
            prop_assert!((normal[1] / normal[2] + by_y).abs() < 1e-3, "{normal:?} {by_y}");
        }

        #[test]
        fn outside_the_edge_goes_on(field in any_field(), x in -5.0f32..5.0, y in -5.0f32..5.0) {
            let edge = field.height(x.clamp(-0.75, 0.75), y.clamp(-0.5, 0.5));
            prop_assert!((field.height(x, y) - edge).abs() < 1e-6);
            let normal = field.normal(x, y);
            prop_assert!(x.abs() < 0.75 || normal[0] == 0.0 || x.abs() == 0.75);
            prop_assert!(y.abs() < 0.5 || normal[1] == 0.0 || y.abs() == 0.5);
        }

        #[test]
        fn a_part_has_the_heights_of_the_whole(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75) {
            let part = field.around(x, y, 1);
            prop_assert!(part.shape().iter().all(|count| (3..=4).contains(count)));
            let [x, y] = [x.clamp(-0.75, 0.75), y.clamp(-0.5, 0.5)];
            prop_assert!((part.height(x, y) - field.height(x, y)).abs() < 1e-5);
        }

        #[test]
        fn nothing_near_is_steeper_than_the_steepest(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75,
            dx in -0.1f32..0.1, dy in -0.1f32..0.1) {
            let (_, [slope_x, slope_y]) = field.height_and_slope(x + dx, y + dy);
            prop_assert!(slope_x.hypot(slope_y) <= field.max_slope(x, y, 0.1) + 1e-5);
        }
    }

    #[test]
    fn cell_is_cut_from_its_far_x_to_its_far_y_corner() {
        let heights = vec![0.0, 0.0, 0.0, 1.0];
        let field = HeightField::new([0.0; 2], 1.0, [2, 2], heights).expect("a field");
        assert_eq!([field.height(0.5, 0.5), field.height(0.25, 0.5), field.height(0.75, 0.75)], [0.0, 0.0, 0.5]);
    }

    #[test]
    fn equal_seeds_give_equal_ground_within_the_height_and_level_at_the_rim() {
        let field = HeightField::random_uniform(0.05, 0.25, 80, 1).expect("a field");
        assert_eq!(field, HeightField::random_uniform(0.05, 0.25, 80, 1).expect("a field"));
        assert_ne!(field, HeightField::random_uniform(0.05, 0.25, 80, 2).expect("a field"));
        assert!(field.heights().iter().all(|height| (0.0..=0.05).contains(height)));
        let mean = field.heights().iter().sum::<f32>() / field.heights().len() as f32;
        assert!((mean - 0.025).abs() < 0.002, "{mean}");
        assert_eq!([field.height(10.0, 3.3), field.height(-1.7, -12.0)], [0.0; 2]);
        assert_eq!(field.normal(10.5, 3.3), [0.0, 0.0, 1.0]);
    }

    #[test]
    fn grid_that_is_none_is_refused_with_the_reason() {
        let refused =
            |cell, shape, heights| HeightField::centred(cell, shape, heights).expect_err("refused").to_string();
        assert_eq!(refused(1.0, [2, 3], vec![0.0; 5]), "`heights` has 5 entries; 2 rows and 3 columns have 6");
        assert_eq!(
            refused(1.0, [1, 3], vec![0.0; 3]),
            "a height field has at least 2 rows and 2 columns; 1 and 3 were given"
        );
        assert_eq!(refused(f32::NAN, [2, 2], vec![0.0; 4]), "`cell` = NaN m is not allowed: 0.001 to 1000 m");
        assert_eq!(refused(1.0, [2, 2], vec![f32::INFINITY; 4]), "`heights` is not finite");
    }
}
