//! Spectral line: the strongest frequency of a residual that does not depend on any channel.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Vector2};

/// Range of frequencies [Hz].
const FREQUENCIES_HZ: [f64; 2] = [0.5, 25.0];

/// Time from the first value on in which a line is looked for [s]. The number of frequencies and that of rows both grow with it.
const LONGEST_S: f64 = 60.0;

/// Returns the frequency [Hz] of the sine that explains most of `values` at times `t` [s], and the explained fraction.
///
/// The sine is fitted to one fold and evaluated on the other. Returns `None` without values.
pub fn spectral_line(t: &[f64], values: &[f64], folds: &[usize]) -> Option<(f64, f64)> {
    let [low, high] = FREQUENCIES_HZ;
    let start = *t.first()?;
    let count = t.partition_point(|t| *t <= start + LONGEST_S);
    let (t, values, folds) = (&t[..count], &values[..count], &folds[..count]);
    let length = t.last()? - start;
    // Four frequencies per line width.
    let step = 0.25 / length.max(1.0);
    let mut waves = vec![Wave::default(); ((high - low) / step) as usize];
    let (mut power, mean) = ([0.0; 2], values.iter().sum::<f64>() / values.len().max(1) as f64);
    for ((t, value), fold) in t.iter().zip(values).zip(folds) {
        power[*fold] += (value - mean).powi(2);
        // The phase of one row grows by the same angle from frequency to frequency.
        let (mut sine, mut cosine) = (TAU * low * t).sin_cos();
        let (turn_sine, turn_cosine) = (TAU * step * t).sin_cos();
        for wave in &mut waves {
            wave.add(*fold, [sine, cosine], value - mean);
            (sine, cosine) = (sine * turn_cosine + cosine * turn_sine, cosine * turn_cosine - sine * turn_sine);
        }
    }
    let shares = waves.iter().enumerate().map(|(index, wave)| (low + step * index as f64, wave.share(power)));
    shares.max_by(|one, other| one.1.total_cmp(&other.1))
}

/// Sums of a sine and cosine of one frequency, by fold.
#[derive(Clone, Copy, Default)]
struct Wave {
    /// Sums of sin², sin·cos and cos².
    normal: [[f64; 3]; 2],
    /// Products with the values.
    moment: [[f64; 2]; 2],
}

impl Wave {
    fn add(&mut self, fold: usize, [sine, cosine]: [f64; 2], value: f64) {
        let (normal, moment) = (&mut self.normal[fold], &mut self.moment[fold]);
        *normal = [normal[0] + sine * sine, normal[1] + sine * cosine, normal[2] + cosine * cosine];
        *moment = [moment[0] + sine * value, moment[1] + cosine * value];
    }

    /// Returns the fraction of the values' power that amplitudes from the other fold explain.
    fn share(&self, power: [f64; 2]) -> f64 {
        let normal = self.normal.map(|[a, b, c]| Matrix2::new(a, b, b, c));
        let moment = self.moment.map(Vector2::from);
        // |v − w·a|² = |v|² − 2 a·m + a·N a, with a from the other fold.
        let rest = |fold: usize| {
            let fitted = normal[1 - fold].cholesky().map_or(Vector2::zeros(), |factor| factor.solve(&moment[1 - fold]));
            power[fold] - 2.0 * fitted.dot(&moment[fold]) + fitted.dot(&(normal[fold] * fitted))
        };
        1.0 - (rest(0) + rest(1)) / (power[0] + power[1]).max(1e-30)
    }
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
