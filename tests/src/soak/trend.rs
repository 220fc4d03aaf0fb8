//! Slope of a time series, with an interval that allows for correlated errors.

use rand::RngExt;
use twinstep_model::Stream;

/// Number of bootstrap samples.
const SAMPLES: usize = 2000;
/// Number of blocks in which errors are resampled together.
const BLOCKS: usize = 15;

/// Slope of a line, with its 95 % interval, per unit of time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trend {
    /// Least-squares slope.
    pub slope: f64,
    /// Lower and upper end of the 95 % interval.
    pub interval: [f64; 2],
}

/// Estimates the slope of `values` at equidistant times, one apart.
///
/// The interval is that of a block bootstrap: the errors of the fitted line are resampled in contiguous blocks, so that
/// their correlation within a block is kept (Künsch 1989).
pub fn trend(values: &[f64], random: &mut Stream) -> Trend {
    let (offset, slope) = fit(values);
    let line = |row: usize| offset + slope * row as f64;
    let errors: Vec<f64> = values.iter().enumerate().map(|(row, value)| value - line(row)).collect();
    let length = (values.len() / BLOCKS).max(1);
    let mut slopes: Vec<f64> = (0..SAMPLES)
        .map(|_| {
            let mut resampled = Vec::with_capacity(values.len() + length);
            while resampled.len() < values.len() {
                let start = random.random_range(0..=errors.len().saturating_sub(length));
                resampled.extend_from_slice(&errors[start..(start + length).min(errors.len())]);
            }
            resampled.truncate(values.len());
            slope + fit(&resampled).1
        })
        .collect();
    slopes.sort_by(f64::total_cmp);
    let quantile = |share: f64| slopes[(share * (SAMPLES - 1) as f64).round() as usize];
    Trend { slope, interval: [quantile(0.025), quantile(0.975)] }
}

/// Returns offset and slope of the least-squares line.
fn fit(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let (middle, mean) = (0.5 * (n - 1.0), values.iter().sum::<f64>() / n);
    let deviation = |row: usize| row as f64 - middle;
    let covariance: f64 = values.iter().enumerate().map(|(row, value)| deviation(row) * (value - mean)).sum();
    let variance: f64 = (0..values.len()).map(|row| deviation(row).powi(2)).sum();
    let slope = if variance > 0.0 { covariance / variance } else { 0.0 };
    (mean - slope * middle, slope)
}

#[cfg(test)]
mod tests {
    use twinstep_model::{standard_normal, stream};

    use super::*;

    #[test]
    fn line_has_its_slope_and_no_interval() {
        let line: Vec<f64> = (0..100).map(|row| 3.0 + 0.25 * f64::from(row)).collect();
        let Trend { slope, interval: [low, high] } = trend(&line, &mut stream(1, "test", 0));
        assert!((slope - 0.25).abs() < 1e-12 && (high - low).abs() < 1e-9);
    }

    #[test]
    fn interval_covers_the_slope_of_correlated_noise_in_most_cases() {
        const CASES: u64 = 100;
        let covered = (0..CASES).filter(|case| {
            let mut random = stream(*case, "test", 0);
            let mut error = 0.0;
            let noise = (0..600).map(|row| {
                error = 0.9 * error + standard_normal(&mut random);
                0.01 * f64::from(row) + error
            });
            let values: Vec<f64> = noise.collect();
            let [low, high] = trend(&values, &mut stream(*case, "bootstrap", 0)).interval;
            (low..=high).contains(&0.01)
        });
        // Nominal: 95. The bootstrap of few blocks is somewhat too narrow.
        let covered = covered.count();
        assert!(covered >= 85, "{covered} of {CASES}");
    }
}
