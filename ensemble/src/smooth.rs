//! Cubic smoothing spline (U2E §IV-B) of equidistant samples.
//!
//! It minimises Σ (y − f)² + λ ∫ f″² (Reinsch 1967): f = y − λ Q γ with (R + λ QᵀQ) γ = Qᵀ y. Q computes second
//! differences; R has 2/3 on its diagonal and 1/6 on the two adjacent ones. The filter is not causal, so an actuator
//! cannot apply it.

use std::f64::consts::TAU;

/// Returns the smoothed `values`, sampled every `dt` \[s].
///
/// It is a low-pass filter with gain ½ at the frequency `hz`.
pub fn smoothed(values: &[f64], hz: f64, dt: f64) -> Vec<f64> {
    if values.len() < 3 {
        return values.to_vec();
    }
    let cos = (TAU * hz * dt).cos();
    // The gain at an angle per sample is 1 / (1 + λ (2 − 2 cos)² / (2/3 + cos/3)).
    let lambda = (2.0 / 3.0 + cos / 3.0) / (2.0 - 2.0 * cos).powi(2);
    let second = |row: usize| values[row] - 2.0 * values[row + 1] + values[row + 2];
    let gamma = solve(
        [2.0 / 3.0 + 6.0 * lambda, 1.0 / 6.0 - 4.0 * lambda, lambda],
        (0..values.len() - 2).map(second).collect(),
    );
    let gamma_at = |row: isize| usize::try_from(row).ok().and_then(|row| gamma.get(row)).copied().unwrap_or(0.0);
    let smooth = |(row, value): (usize, &f64)| {
        let row = row as isize;
        value - lambda * (gamma_at(row) - 2.0 * gamma_at(row - 1) + gamma_at(row - 2))
    };
    values.iter().enumerate().map(smooth).collect()
}

/// Solves a symmetric positive definite pentadiagonal Toeplitz system by L D Lᵀ.
///
/// The arguments are the main diagonal and the first and second off-diagonals, then the right-hand side.
fn solve([diagonal, first, second]: [f64; 3], mut right: Vec<f64>) -> Vec<f64> {
    let count = right.len();
    // For each column: D, and L one and two rows below the diagonal.
    let mut factors: Vec<[f64; 3]> = Vec::with_capacity(count);
    for row in 0..count {
        let [one, two] = [1, 2].map(|back| row.checked_sub(back).map_or([0.0; 3], |before| factors[before]));
        let d = diagonal - one[0] * one[1] * one[1] - two[0] * two[2] * two[2];
        factors.push([d, (first - one[0] * one[1] * one[2]) / d, second / d]);
    }
    for row in 0..count {
        for back in 1..=row.min(2) {
            right[row] -= factors[row - back][back] * right[row - back];
        }
    }
    for row in (0..count).rev() {
        right[row] /= factors[row][0];
        for ahead in 1..=2.min(count - 1 - row) {
            right[row] -= factors[row][ahead] * right[row + ahead];
        }
    }
    right
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const DT: f64 = 0.005;

    fn wave(hz: f64) -> Vec<f64> {
        (0..2000).map(|row| (TAU * hz * f64::from(row) * DT).sin()).collect()
    }

    /// Returns the largest absolute value away from the ends.
    fn amplitude(values: &[f64]) -> f64 {
        values[500..1500].iter().fold(0.0, |max, value| max.max(value.abs()))
    }

    #[test]
    fn gain_is_one_at_low_half_at_the_cutoff_and_zero_at_high_frequencies() {
        for (hz, expected) in [(2.0, 1.0), (20.0, 0.5), (80.0, 0.0)] {
            let found = amplitude(&smoothed(&wave(hz), 20.0, DT)) / amplitude(&wave(hz));
            assert!((found - expected).abs() < 0.01, "{hz} Hz: {found}");
        }
    }

    #[test]
    fn spline_minimises_its_cost() {
        let values = [0.3, -0.2, 1.0, 0.8, -0.5, 0.1, 0.9];
        let (hz, cos) = (30.0, (TAU * 30.0 * DT).cos());
        let lambda = (2.0 / 3.0 + cos / 3.0) / (2.0 - 2.0 * cos).powi(2);
        // ∫ f″² of the spline through f is γᵀ R γ with R γ = Qᵀ f.
        let cost = |f: &[f64]| {
            let second: Vec<f64> = f.windows(3).map(|f| f[0] - 2.0 * f[1] + f[2]).collect();
            let gamma = solve([2.0 / 3.0, 1.0 / 6.0, 0.0], second.clone());
            let bending: f64 = gamma.iter().zip(&second).map(|(gamma_at, second)| gamma_at * second).sum();
            values.iter().zip(f).map(|(value, f)| (value - f).powi(2)).sum::<f64>() + lambda * bending
        };
        let best = smoothed(&values, hz, DT);
        for row in 0..values.len() {
            for side in [-1e-3, 1e-3] {
                let mut other = best.clone();
                other[row] += side;
                assert!(cost(&other) > cost(&best), "row {row}");
            }
        }
    }

    proptest! {
        #[test]
        fn straight_lines_do_not_change(slope in -5.0..5.0, start in -5.0..5.0, rows in 1usize..60, hz in 1.0..90.0) {
            let line: Vec<f64> = (0..rows).map(|row| start + slope * row as f64).collect();
            for (one, other) in smoothed(&line, hz, DT).iter().zip(&line) {
                prop_assert!((one - other).abs() < 1e-6);
            }
        }
    }
}
