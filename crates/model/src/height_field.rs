//! Height field: heights on a grid, with two triangles per cell.

use rand::RngExt;

use crate::stream;

/// Heights on a grid of square cells.
///
/// Vertex (`row`, `column`) is at `origin + cell_size · (row, column)`: rows are along x, columns along y. Each cell is
/// two triangles, split along the diagonal from vertex (`row + 1`, `column`) to (`row`, `column + 1`). Outside the grid
/// the height is that of the nearest point of the edge.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightField {
    origin: [f32; 2],
    cell_size: f32,
    /// 1 / `cell_size`.
    inv_cell_size: f32,
    rows: usize,
    columns: usize,
    heights: Vec<f32>,
}

/// Reason why a grid is not a valid height field.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum HeightFieldError {
    /// The grid has less than four vertices.
    #[error("a height field needs at least 2 rows and 2 columns; {rows} and {columns} were given")]
    TooSmall {
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        columns: usize,
    },
    /// The number of heights is not the number of vertices.
    #[error("`heights` has {given} entries; {rows} rows and {columns} columns have {}", rows.saturating_mul(*columns))]
    WrongLength {
        /// Number of heights.
        given: usize,
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        columns: usize,
    },
    /// A height or the origin is not finite.
    #[error("`{0}` is not finite")]
    NotFinite(&'static str),
    /// The size of the cells is out of range.
    #[error("`cell_size` = {0} m is not allowed: 0.001 to 1000 m")]
    Cell(f32),
}

impl HeightField {
    /// Creates a field of `rows` × `columns` heights [m], row by row, whose vertex (0, 0) is at `origin` [m].
    ///
    /// `cell_size` is the distance between neighbouring vertices [m].
    pub fn new(
        origin: [f32; 2],
        cell_size: f32,
        [rows, columns]: [usize; 2],
        heights: Vec<f32>,
    ) -> Result<Self, HeightFieldError> {
        if rows < 2 || columns < 2 {
            return Err(HeightFieldError::TooSmall { rows, columns });
        }
        if rows.checked_mul(columns) != Some(heights.len()) {
            return Err(HeightFieldError::WrongLength { given: heights.len(), rows, columns });
        }
        if !(1e-3..=1e3).contains(&cell_size) {
            return Err(HeightFieldError::Cell(cell_size));
        }
        for (name, values) in [("origin", origin.as_slice()), ("heights", &heights)] {
            if values.iter().any(|value| !value.is_finite()) {
                return Err(HeightFieldError::NotFinite(name));
            }
        }
        Ok(Self { origin, cell_size, inv_cell_size: 1.0 / cell_size, rows, columns, heights })
    }

    /// Creates a field as [`HeightField::new`] does, with the centre of the grid at the origin.
    pub fn centred(cell_size: f32, shape: [usize; 2], heights: Vec<f32>) -> Result<Self, HeightFieldError> {
        Self::new(shape.map(|count| -0.5 * cell_size * (count as f32 - 1.0)), cell_size, shape, heights)
    }

    /// Creates a square of `cells` × `cells` around the origin, with heights sampled uniformly from 0 to `height` [m].
    ///
    /// The border is at height 0, so that the field continues as the plane z = 0.
    pub fn random_uniform(height: f32, cell_size: f32, cells: usize, seed: u64) -> Result<Self, HeightFieldError> {
        let mut stream = stream(seed, "rough", 0);
        let mut heights = Vec::with_capacity((cells + 1) * (cells + 1));
        for row in 0..=cells {
            for column in 0..=cells {
                let drawn = height * stream.random::<f32>();
                let on_border = row % cells.max(1) == 0 || column % cells.max(1) == 0;
                heights.push(if on_border { 0.0 } else { drawn });
            }
        }
        Self::centred(cell_size, [cells + 1; 2], heights)
    }

    /// Creates a square of `cells` × `cells` around the origin, with level treads of height 0 or `height` [m] at random.
    ///
    /// A tread is `tread_cells` long and wide with the face to its neighbour, which is as wide as a cell. The border is
    /// at height 0, so that the field continues as the plane z = 0.
    pub fn random_steps(
        height: f32,
        cell_size: f32,
        tread_cells: usize,
        cells: usize,
        seed: u64,
    ) -> Result<Self, HeightFieldError> {
        let (mut stream, treads) = (stream(seed, "steps", 0), cells / tread_cells.max(1) + 1);
        let is_high: Vec<bool> = (0..treads * treads).map(|_| stream.random()).collect();
        let mut heights = Vec::with_capacity((cells + 1) * (cells + 1));
        for row in 0..=cells {
            for column in 0..=cells {
                let on_border = row % cells.max(1) == 0 || column % cells.max(1) == 0;
                let is_high = is_high[row / tread_cells.max(1) * treads + column / tread_cells.max(1)];
                heights.push(if is_high && !on_border { height } else { 0.0 });
            }
        }
        Self::centred(cell_size, [cells + 1; 2], heights)
    }

    /// Returns the position of vertex (0, 0) [m].
    pub fn origin(&self) -> [f32; 2] {
        self.origin
    }

    /// Returns the distance between neighbouring vertices [m].
    pub fn cell_size(&self) -> f32 {
        self.cell_size
    }

    /// Returns the number of vertices along x and along y.
    pub fn shape(&self) -> [usize; 2] {
        [self.rows, self.columns]
    }

    /// Returns the height of every vertex [m], row by row.
    pub fn heights(&self) -> &[f32] {
        &self.heights
    }

    /// Returns the height of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn height(&self, x: f32, y: f32) -> f32 {
        self.height_and_slope(x, y).0
    }

    /// Returns the unit normal of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn normal(&self, x: f32, y: f32) -> [f32; 3] {
        self.sample(x, y).1
    }

    /// Returns the height [m] and unit normal of the surface at (`x`, `y`) [m].
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> (f32, [f32; 3]) {
        let (height, [slope_x, slope_y]) = self.height_and_slope(x, y);
        let up = 1.0 / (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt();
        (height, [-slope_x * up, -slope_y * up, up])
    }

    /// Returns the height [m] and its derivatives with respect to x and y at (`x`, `y`) [m].
    #[inline]
    pub fn height_and_slope(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let (row, u, inside_x) = locate((x - self.origin[0]) * self.inv_cell_size, self.rows);
        let (column, v, inside_y) = locate((y - self.origin[1]) * self.inv_cell_size, self.columns);
        let [near, far_x, far_y, far] = self.cell_heights(row, column);
        // Both triangles have the vertices `far_x` and `far_y`; the third one is `near` or `far`.
        let nearer = u + v <= 1.0;
        let (base, a, b) = if nearer { (near, u, v) } else { (far, u - 1.0, v - 1.0) };
        let rise_x = if nearer { far_x - near } else { far - far_y };
        let rise_y = if nearer { far_y - near } else { far - far_x };
        let slope = [rise_x * self.inv_cell_size * inside_x, rise_y * self.inv_cell_size * inside_y];
        (base + a * rise_x + b * rise_y, slope)
    }

    /// Returns the heights [m] of a cell's vertices: (0, 0), (1, 0), (0, 1) and (1, 1) relative to `row` and `column`.
    #[inline]
    fn cell_heights(&self, row: usize, column: usize) -> [f32; 4] {
        let first = row * self.columns + column;
        let second = first + self.columns;
        [self.heights[first], self.heights[second], self.heights[first + 1], self.heights[second + 1]]
    }

    /// Returns the largest slope (rise over run) of the cells within `radius` [m] of (`x`, `y`) along either axis.
    pub fn max_slope(&self, x: f32, y: f32, radius: f32) -> f32 {
        let range = |value: f32, origin: f32, count: usize| {
            let cell = |value: f32| locate((value - origin) * self.inv_cell_size, count).0;
            cell(value - radius)..=cell(value + radius)
        };
        let mut steepest = 0.0f32;
        for row in range(x, self.origin[0], self.rows) {
            for column in range(y, self.origin[1], self.columns) {
                let [near, far_x, far_y, far] = self.cell_heights(row, column);
                let lower = (far_x - near).hypot(far_y - near);
                let upper = (far - far_y).hypot(far - far_x);
                steepest = steepest.max(lower).max(upper);
            }
        }
        steepest * self.inv_cell_size
    }

    /// Returns the part within `cells` cells of (`x`, `y`) [m] along either axis, at least one cell.
    pub fn around(&self, x: f32, y: f32, cells: usize) -> HeightField {
        let range = |value: f32, origin: f32, count: usize| {
            let (middle, ..) = locate((value - origin) * self.inv_cell_size, count);
            (middle.saturating_sub(cells), (middle + 1 + cells).min(count - 1))
        };
        let (first_row, last_row) = range(x, self.origin[0], self.rows);
        let (first_column, last_column) = range(y, self.origin[1], self.columns);
        let rows = self.heights.chunks_exact(self.columns).take(last_row + 1).skip(first_row);
        let first = [first_row, first_column];
        Self {
            origin: std::array::from_fn(|axis| self.origin[axis] + self.cell_size * first[axis] as f32),
            rows: last_row + 1 - first_row,
            columns: last_column + 1 - first_column,
            heights: rows.flat_map(|row| &row[first_column..=last_column]).copied().collect(),
            ..*self
        }
    }
}

/// Returns the cell of `at` [cells from the first vertex], the position in it from 0 to 1, and 1 inside the grid or 0
/// outside.
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
        let origin = [-0.75, -0.5];
        let at = |index: usize, axis: usize| origin[axis] + CELL * index as f32;
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
        fn heights_of_a_plane_are_interpolated_exactly(a in -1.0f32..1.0, b in -1.0f32..1.0, c in -1.0f32..1.0,
            x in -0.75f32..0.75, y in -0.5f32..0.5) {
            let (height, normal) = field(|x, y| a * x + b * y + c).sample(x, y);
            prop_assert!((height - (a * x + b * y + c)).abs() < 1e-5);
            let length = (1.0 + a * a + b * b).sqrt();
            for (actual, expected) in normal.iter().zip([-a / length, -b / length, 1.0 / length]) {
                prop_assert!((actual - expected).abs() < 1e-5);
            }
        }

        #[test]
        fn surface_is_continuous(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75,
            dx in -1e-3f32..1e-3, dy in -1e-3f32..1e-3) {
            // Heights are within 0.3 m, so the surface rises by at most 0.3 m per cell along x and along y.
            let bound = 0.3 / CELL * (dx.abs() + dy.abs()) + 1e-6;
            prop_assert!((field.height(x + dx, y + dy) - field.height(x, y)).abs() <= bound);
        }

        #[test]
        fn height_at_a_vertex_is_the_given_height(field in any_field(), row in 0..SHAPE[0], column in 0..SHAPE[1]) {
            let [x, y] = [-0.75 + CELL * row as f32, -0.5 + CELL * column as f32];
            prop_assert!((field.height(x, y) - field.heights()[row * SHAPE[1] + column]).abs() < 1e-6);
        }

        #[test]
        fn normal_agrees_with_finite_differences_of_the_height(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75) {
            let normal = field.normal(x, y);
            prop_assert!((normal.iter().map(|value| value * value).sum::<f32>() - 1.0).abs() < 1e-5);
            let step = 1e-3;
            let same = [(-step, -step), (-step, step), (step, -step), (step, step)]
                .iter()
                .all(|(dx, dy)| field.normal(x + dx, y + dy) == normal);
            prop_assume!(same);
            let by_x = (field.height(x + step, y) - field.height(x - step, y)) / (2.0 * step);
            let by_y = (field.height(x, y + step) - field.height(x, y - step)) / (2.0 * step);
            // Heights have seven significant digits; differences over the step have about four.
            prop_assert!((normal[0] / normal[2] + by_x).abs() < 1e-3, "{normal:?} {by_x}");
            prop_assert!((normal[1] / normal[2] + by_y).abs() < 1e-3, "{normal:?} {by_y}");
        }

        #[test]
        fn height_outside_the_grid_is_that_of_the_edge(field in any_field(), x in -5.0f32..5.0, y in -5.0f32..5.0) {
            let edge = field.height(x.clamp(-0.75, 0.75), y.clamp(-0.5, 0.5));
            prop_assert!((field.height(x, y) - edge).abs() < 1e-6);
            let normal = field.normal(x, y);
            prop_assert!(x.abs() < 0.75 || normal[0] == 0.0 || x.abs() == 0.75);
            prop_assert!(y.abs() < 0.5 || normal[1] == 0.0 || y.abs() == 0.5);
        }

        #[test]
        fn cropped_field_has_the_heights_of_the_whole(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75) {
            let part = field.around(x, y, 1);
            prop_assert!(part.shape().iter().all(|count| (3..=4).contains(count)));
            let [x, y] = [x.clamp(-0.75, 0.75), y.clamp(-0.5, 0.5)];
            prop_assert!((part.height(x, y) - field.height(x, y)).abs() < 1e-5);
        }

        #[test]
        fn slope_near_a_point_is_at_most_the_maximum_slope(field in any_field(), x in -1.0f32..1.0, y in -0.75f32..0.75,
            dx in -0.1f32..0.1, dy in -0.1f32..0.1) {
            let (_, [slope_x, slope_y]) = field.height_and_slope(x + dx, y + dy);
            prop_assert!(slope_x.hypot(slope_y) <= field.max_slope(x, y, 0.1) + 1e-5);
        }
    }

    #[test]
    fn cell_is_split_along_the_diagonal_from_its_x_to_its_y_vertex() {
        let heights = vec![0.0, 0.0, 0.0, 1.0];
        let field = HeightField::new([0.0; 2], 1.0, [2, 2], heights).expect("a field");
        assert_eq!([field.height(0.5, 0.5), field.height(0.25, 0.5), field.height(0.75, 0.75)], [0.0, 0.0, 0.5]);
    }

    #[test]
    fn random_field_is_reproducible_within_its_height_and_zero_at_the_border() {
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
    fn invalid_grids_are_rejected_with_the_reason() {
        let refused = |cell_size, shape, heights| {
            HeightField::centred(cell_size, shape, heights).expect_err("refused").to_string()
        };
        assert_eq!(refused(1.0, [2, 3], vec![0.0; 5]), "`heights` has 5 entries; 2 rows and 3 columns have 6");
        assert_eq!(
            refused(1.0, [1, 3], vec![0.0; 3]),
            "a height field needs at least 2 rows and 2 columns; 1 and 3 were given"
        );
        assert_eq!(refused(f32::NAN, [2, 2], vec![0.0; 4]), "`cell_size` = NaN m is not allowed: 0.001 to 1000 m");
        assert_eq!(refused(1.0, [2, 2], vec![f32::INFINITY; 4]), "`heights` is not finite");
    }
}
