//! Linear least squares with few unknowns.

/// Coefficients with their standard errors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Estimate<const N: usize> {
    pub values: [f64; N],
    pub errors: [f64; N],
    /// Variance of what the regressors do not explain.
    pub variance: f64,
}

/// Returns the coefficients that minimise `Σ (y − x · coefficients)²`; `None` if the rows do not determine them.
///
/// `rows` has the regressors and the result of each sample.
pub(super) fn least_squares<const N: usize>(rows: &[([f64; N], f64)]) -> Option<Estimate<N>> {
    let mut normal = [[0.0; N]; N];
    let mut right = [0.0; N];
    for (x, y) in rows {
        for i in 0..N {
            right[i] += x[i] * y;
            for k in 0..N {
                normal[i][k] += x[i] * x[k];
            }
        }
    }
    // Scaled to a diagonal of 1, so that a small pivot means dependent regressors.
    let scale: [f64; N] = std::array::from_fn(|i| normal[i][i].sqrt());
    if scale.iter().any(|scale| *scale < 1e-9) {
        return None;
    }
    for i in 0..N {
        right[i] /= scale[i];
        for k in 0..N {
            normal[i][k] /= scale[i] * scale[k];
        }
    }
    let solution = eliminate(normal, right)?;
    let values: [f64; N] = std::array::from_fn(|i| solution[i] / scale[i]);
    let residual = |(x, y): &([f64; N], f64)| y - (0..N).map(|i| x[i] * values[i]).sum::<f64>();
    let square: f64 = rows.iter().map(|row| residual(row).powi(2)).sum();
    let variance = square / rows.len().saturating_sub(N).max(1) as f64;
    let mut errors = [0.0; N];
    for (i, error) in errors.iter_mut().enumerate() {
        let unit = std::array::from_fn(|k| if k == i { 1.0 } else { 0.0 });
        *error = (variance * eliminate(normal, unit)?[i]).sqrt() / scale[i];
    }
    Some(Estimate { values, errors, variance })
}

/// Solves a symmetric positive definite system; `None` if it is nearly singular.
fn eliminate<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N]) -> Option<[f64; N]> {
    for pivot in 0..N {
        if matrix[pivot][pivot] < MIN_PIVOT {
            return None;
        }
        for row in pivot + 1..N {
            let factor = matrix[row][pivot] / matrix[pivot][pivot];
            let upper = matrix[pivot];
            for (value, above) in matrix[row].iter_mut().zip(upper) {
                *value -= factor * above;
            }
            right[row] -= factor * right[pivot];
        }
    }
    for row in (0..N).rev() {
        let known: f64 = (row + 1..N).map(|column| matrix[row][column] * right[column]).sum();
        right[row] = (right[row] - known) / matrix[row][row];
    }
    Some(right)
}

/// Smallest pivot of a system with a diagonal of 1: the share of a regressor that the others do not explain.
const MIN_PIVOT: f64 = 1e-4;

/// Returns the rows with the mean of each column subtracted.
pub(super) fn centred<const N: usize>(mut rows: Vec<([f64; N], f64)>) -> Vec<([f64; N], f64)> {
    let count = rows.len().max(1) as f64;
    let mean_x: [f64; N] = std::array::from_fn(|i| rows.iter().map(|(x, _)| x[i]).sum::<f64>() / count);
    let mean_y = rows.iter().map(|(_, y)| y).sum::<f64>() / count;
    for (x, y) in &mut rows {
        for i in 0..N {
            x[i] -= mean_x[i];
        }
        *y -= mean_y;
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_of_a_line_are_found() {
        let rows = (0..20).map(|i| {
            let (a, b) = (f64::from(i), f64::from(i * i % 7));
            ([a, b], 3.0 + 2.0 * a - 5.0 * b)
        });
        let estimate = least_squares(&centred(rows.collect())).expect("a solution");
        let [a, b] = estimate.values;
        assert!((a - 2.0).abs() < 1e-9 && (b + 5.0).abs() < 1e-9);
        assert!(estimate.errors.iter().all(|error| *error < 1e-9));
    }

    #[test]
    fn dependent_regressors_have_no_solution() {
        let rows: Vec<_> = (0..20).map(|i| ([f64::from(i), f64::from(2 * i)], 1.0)).collect();
        assert!(least_squares(&centred(rows)).is_none());
    }
}
