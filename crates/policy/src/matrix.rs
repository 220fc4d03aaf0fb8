//! Products of small row-major matrices on SIMD registers.
//!
//! `C += A · B` in tiles that stay in registers: `ROWS` rows of C by `REGISTERS` registers of its columns. Every entry of
//! C is a sum over k in ascending order, so its bits depend neither on the registers nor on the tile.
//!
//! All functions must be inlined, because only their callers are compiled for the instruction set of the processor.

use twinstep_simd::SimdFloat;

/// Columns of C, and so columns of B, are a multiple of this number; the widest register has as many lanes.
pub const COLUMN_STEP: usize = 16;
/// Rows of C are a multiple of this number.
pub const ROW_STEP: usize = 8;
/// Number of columns of B that fit into the fastest cache with all their rows.
const BLOCK: usize = 64;

/// The left factor A of a product.
#[derive(Clone, Copy)]
pub struct Left<'a> {
    /// Entries, row-major.
    pub values: &'a [f32],
    /// Distance between rows in memory.
    pub stride: usize,
    /// True if A is the transpose of the matrix in memory.
    pub is_transposed: bool,
}

/// The right factor B of a product, row-major, in blocks of columns.
#[derive(Clone, Copy)]
pub struct Right<'a> {
    /// Entries.
    pub values: &'a [f32],
    /// Number of rows.
    pub rows: usize,
    /// Number of columns, a multiple of [`COLUMN_STEP`].
    pub columns: usize,
    /// True if [`pack`] has arranged the entries.
    pub is_packed: bool,
}

impl<'a> Right<'a> {
    /// Returns the entries from column `first` of a block on, and the distance between rows in memory.
    #[inline(always)]
    fn columns_from(self, first: usize) -> (&'a [f32], usize) {
        if !self.is_packed {
            return (&self.values[first..], self.columns);
        }
        let block = first / BLOCK * BLOCK;
        let stride = (self.columns - block).min(BLOCK);
        (&self.values[block * self.rows + first - block..], stride)
    }
}

/// Arranges a row-major matrix in blocks of columns that are contiguous in memory.
pub fn pack(values: &[f32], rows: usize, columns: usize, packed: &mut [f32]) {
    for block in (0..columns).step_by(BLOCK) {
        let width = (columns - block).min(BLOCK);
        let to = &mut packed[block * rows..];
        for (row, entries) in to.chunks_exact_mut(width).take(rows).enumerate() {
            entries.copy_from_slice(&values[row * columns + block..][..width]);
        }
    }
}

/// Adds `left · right` to the first `rows` rows of `product`, which has as many columns as `right`.
///
/// `rows` is a multiple of [`ROW_STEP`].
#[inline(always)]
pub fn add_product<T: SimdFloat>(left: Left, right: Right, rows: usize, product: &mut [f32]) {
    let wide = if T::LANES == COLUMN_STEP { BLOCK } else { 2 * T::LANES };
    let mut column = 0;
    while column < right.columns {
        let end = right.columns.min(column + BLOCK);
        while column + wide <= end {
            if T::LANES == COLUMN_STEP {
                add_columns::<T, 4, 4>(left, right, rows, column, product);
            } else {
                add_columns::<T, 4, 2>(left, right, rows, column, product);
            }
            column += wide;
        }
        while column < end {
            // Remainders exist for the widest registers only.
            add_columns::<T, 8, 1>(left, right, rows, column, product);
            column += T::LANES;
        }
    }
}

/// Adds the product to `REGISTERS` registers of columns, for all rows.
#[inline(always)]
fn add_columns<T: SimdFloat, const ROWS: usize, const REGISTERS: usize>(
    left: Left,
    right: Right,
    rows: usize,
    column: usize,
    product: &mut [f32],
) {
    let (b, b_stride) = right.columns_from(column);
    let mut row = 0;
    while row < rows {
        let c = &mut product[row * right.columns + column..];
        if left.is_transposed {
            tile_transposed::<T, ROWS, REGISTERS>(&left.values[row..], left.stride, b, b_stride, right, c);
        } else {
            tile::<T, ROWS, REGISTERS>(&left.values[row * left.stride..], left.stride, b, b_stride, right, c);
        }
        row += ROWS;
    }
}

#[inline(always)]
fn tile<T: SimdFloat, const ROWS: usize, const REGISTERS: usize>(
    a: &[f32],
    a_stride: usize,
    b: &[f32],
    b_stride: usize,
    right: Right,
    c: &mut [f32],
) {
    let mut sums = load_tile::<T, ROWS, REGISTERS>(c, right.columns);
    let mut a_rows = [a; ROWS];
    for row in 0..ROWS {
        a_rows[row] = &a[row * a_stride..][..right.rows];
    }
    for k in 0..right.rows {
        let entries = load_row::<T, REGISTERS>(&b[k * b_stride..]);
        for row in 0..ROWS {
            let factor = T::splat(f64::from(a_rows[row][k]));
            for register in 0..REGISTERS {
                sums[row][register] = factor.mul_add(entries[register], sums[row][register]);
            }
        }
    }
    store_tile(&sums, c, right.columns);
}

#[inline(always)]
fn tile_transposed<T: SimdFloat, const ROWS: usize, const REGISTERS: usize>(
    a: &[f32],
    a_stride: usize,
    b: &[f32],
    b_stride: usize,
    right: Right,
    c: &mut [f32],
) {
    let mut sums = load_tile::<T, ROWS, REGISTERS>(c, right.columns);
    for k in 0..right.rows {
        let entries = load_row::<T, REGISTERS>(&b[k * b_stride..]);
        let column = &a[k * a_stride..][..ROWS];
        for row in 0..ROWS {
            let factor = T::splat(f64::from(column[row]));
            for register in 0..REGISTERS {
                sums[row][register] = factor.mul_add(entries[register], sums[row][register]);
            }
        }
    }
    store_tile(&sums, c, right.columns);
}

#[inline(always)]
fn load_row<T: SimdFloat, const REGISTERS: usize>(values: &[f32]) -> [T; REGISTERS] {
    let values = &values[..REGISTERS * T::LANES];
    let mut entries = [T::splat(0.0); REGISTERS];
    for register in 0..REGISTERS {
        entries[register] = T::load(&values[register * T::LANES..][..T::LANES]);
    }
    entries
}

#[inline(always)]
fn load_tile<T: SimdFloat, const ROWS: usize, const REGISTERS: usize>(
    c: &[f32],
    stride: usize,
) -> [[T; REGISTERS]; ROWS] {
    let mut sums = [[T::splat(0.0); REGISTERS]; ROWS];
    for row in 0..ROWS {
        sums[row] = load_row(&c[row * stride..]);
    }
    sums
}

#[inline(always)]
fn store_tile<T: SimdFloat, const ROWS: usize, const REGISTERS: usize>(
    sums: &[[T; REGISTERS]; ROWS],
    c: &mut [f32],
    stride: usize,
) {
    for row in 0..ROWS {
        for register in 0..REGISTERS {
            sums[row][register].store(&mut c[row * stride + register * T::LANES..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::RngExt;
    use twinstep_model::stream;
    use twinstep_simd::{InstructionSet, SimdKernel, SimdTask, with_f32};

    use super::*;

    struct Product<'a>(Left<'a>, Right<'a>, usize, &'a mut [f32]);

    struct OnRegisters<'a, T>(Product<'a>, std::marker::PhantomData<T>);

    impl<T: SimdFloat> SimdKernel for OnRegisters<'_, T> {
        type Output = ();

        #[inline(always)]
        fn run(self) {
            let Product(left, right, rows, product) = self.0;
            add_product::<T>(left, right, rows, product);
        }
    }

    impl SimdTask for Product<'_> {
        type Output = ();

        fn run<T: SimdFloat>(self) {
            T::vectorise(OnRegisters::<T>(self, std::marker::PhantomData));
        }
    }

    proptest! {
        #[test]
        fn products_are_sums_in_ascending_order_on_every_instruction_set(
            row_steps in 1..4usize, inner in 1..40usize, column_steps in 1..10usize, seed in 0..1000u64,
            is_transposed in any::<bool>(), is_packed in any::<bool>(),
        ) {
            let (rows, columns) = (row_steps * ROW_STEP, column_steps * COLUMN_STEP);
            let mut random = stream(seed, "matrix", 0);
            let mut matrix = |len: usize| -> Vec<f32> { (0..len).map(|_| random.random::<f32>() - 0.5).collect() };
            let (a, b, c) = (matrix(rows * inner), matrix(inner * columns), matrix(rows * columns));
            let entry = |row: usize, k: usize| if is_transposed { a[k * rows + row] } else { a[row * inner + k] };
            let expected: Vec<f32> = (0..rows * columns).map(|index| {
                let (row, column) = (index / columns, index % columns);
                (0..inner).fold(c[index], |sum, k| entry(row, k).mul_add(b[k * columns + column], sum))
            }).collect();
            let mut packed = vec![0.0; b.len()];
            pack(&b, inner, columns, &mut packed);
            let left = Left { values: &a, stride: if is_transposed { rows } else { inner }, is_transposed };
            let right = Right { values: if is_packed { &packed } else { &b }, rows: inner, columns, is_packed };
            for instructions in InstructionSet::available() {
                let mut product = c.clone();
                with_f32(instructions, Product(left, right, rows, &mut product));
                prop_assert_eq!(&product, &expected, "{}", instructions);
            }
        }
    }
}
