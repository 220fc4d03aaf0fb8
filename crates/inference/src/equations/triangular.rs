//! Inverses of triangular and positive definite matrices, by products of blocks: several times faster than row by row.

use nalgebra::{Cholesky, DMatrix, Dyn};

/// Size up to which a block is inverted column by column.
const SMALL: usize = 32;

/// Returns the inverse of a lower triangular matrix without zeros on its diagonal.
pub fn inverse_of_lower(lower: &DMatrix<f64>) -> DMatrix<f64> {
    let size = lower.nrows();
    if size <= SMALL {
        let mut inverse = DMatrix::identity(size, size);
        lower.solve_lower_triangular_mut(&mut inverse);
        return inverse;
    }
    let half = size / 2;
    let rest = size - half;
    // Of [A 0; B C] it is [A⁻¹ 0; −C⁻¹ B A⁻¹ C⁻¹].
    let first = inverse_of_lower(&lower.view((0, 0), (half, half)).into_owned());
    let last = inverse_of_lower(&lower.view((half, half), (rest, rest)).into_owned());
    let between = -(&last * lower.view((half, 0), (rest, half)) * &first);
    let mut inverse = DMatrix::zeros(size, size);
    inverse.view_mut((0, 0), (half, half)).copy_from(&first);
    inverse.view_mut((half, half), (rest, rest)).copy_from(&last);
    inverse.view_mut((half, 0), (rest, half)).copy_from(&between);
    inverse
}

/// Returns the inverse of a positive definite matrix from its factor.
pub fn inverse(factor: &Cholesky<f64, Dyn>) -> DMatrix<f64> {
    let lower = inverse_of_lower(&factor.l());
    lower.transpose() * lower
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_times_the_matrix_is_the_identity() {
        for size in [1, 32, 33, 101] {
            let entry = |row: usize, column: usize| ((row * 31 + column * 17) as f64).sin();
            let any = DMatrix::from_fn(size, size, entry);
            let matrix = &any * any.transpose() + DMatrix::identity(size, size);
            let factor = matrix.clone().cholesky().expect("positive definite");
            assert!((inverse(&factor) * &matrix - DMatrix::identity(size, size)).abs().max() < 1e-8, "{size}");
        }
    }
}
