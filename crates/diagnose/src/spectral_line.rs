//! Spectral line: the strongest frequency of a residual that does not depend on any channel.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Vector2};

/// Range of frequencies [Hz].
const FREQUENCIES_HZ: [f64; 2] = [0.5, 25.0];

/// Returns the frequency [Hz] of the sine that explains most of `values` at times `t` [s], and the explained fraction.
///
/// The sine is fitted to one fold and evaluated on the other. Returns `None` without values.
pub fn spectral_line(t: &[f64], values: &[f64], folds: &[usize]) -> Option<(f64, f64)> {
    let [low, high] = FREQUENCIES_HZ;
    let length = t.last()? - t.first()?;
    // Four frequencies per line width.
    let step = 0.25 / length.max(1.0);
    let count = ((high - low) / step) as usize;
    let tried = (0..count).map(|index| low + step * index as f64);
    let shares = tried.map(|frequency| (frequency, share(t, values, folds, frequency)));
    shares.max_by(|one, other| one.1.total_cmp(&other.1))
}

fn share(t: &[f64], values: &[f64], folds: &[usize], frequency: f64) -> f64 {
    let (mut normal, mut moment) = ([Matrix2::zeros(); 2], [Vector2::zeros(); 2]);
    let (mut power, mut count) = ([0.0; 2], [0.0; 2]);
    let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
    for ((t, value), fold) in t.iter().zip(values).zip(folds) {
        let (sine, cosine) = (TAU * frequency * t).sin_cos();
        let wave = Vector2::new(sine, cosine);
        normal[*fold] += wave * wave.transpose();
        moment[*fold] += wave * (value - mean);
        power[*fold] += (value - mean).powi(2);
        count[*fold] += 1.0;
    }
    // |v − w·a|² = |v|² − 2 a·m + a·N a, with a from the other fold.
    let rest = |fold: usize| {
        let fitted = normal[1 - fold].cholesky().map_or(Vector2::zeros(), |factor| factor.solve(&moment[1 - fold]));
        power[fold] - 2.0 * fitted.dot(&moment[fold]) + fitted.dot(&(normal[fold] * fitted))
    };
    1.0 - (rest(0) + rest(1)) / (power[0] + power[1]).max(1e-30)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_is_found_in_noise_of_equal_power_and_not_in_noise_alone() {
        let t: Vec<f64> = (0..4000).map(|row| 0.005 * f64::from(row)).collect();
        let folds: Vec<usize> = t.iter().map(|t| *t as usize % 2).collect();
        let noise = |row: usize| ((row * 7919 % 1009) as f64 / 1009.0 - 0.5) * 3.46;
        let with: Vec<f64> =
            t.iter().enumerate().map(|(row, t)| 1.41 * (TAU * 3.3 * t + 1.0).sin() + noise(row)).collect();
        let without: Vec<f64> = (0..t.len()).map(noise).collect();
        let (frequency, share) = spectral_line(&t, &with, &folds).expect("times");
        assert!((frequency - 3.3).abs() < 0.02 && (share - 0.5).abs() < 0.05, "{frequency} {share}");
        assert!(spectral_line(&t, &without, &folds).expect("times").1 < 0.05);
    }
}
