//! Normalisation of observations by their mean and standard deviation.

use serde::{Deserialize, Serialize};

/// Limit of normalised entries.
pub const CLIP: f32 = 10.0;
/// Added to the variance, so that constant entries stay finite.
const VARIANCE_FLOOR: f64 = 1e-8;

/// Mean and standard deviation of each entry of an observation, estimated from all observations so far.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Normaliser {
    /// Number of observations.
    pub count: f64,
    /// Mean, in the unit of the entry.
    pub mean: Vec<f64>,
    /// Variance, in the square of the unit.
    pub variance: Vec<f64>,
    #[serde(skip)]
    scale: Vec<[f32; 2]>,
}

impl Normaliser {
    /// Creates a normaliser that changes nothing but the range, for observations with `len` entries.
    pub fn identity(len: usize) -> Self {
        Self::from_moments(0.0, vec![0.0; len], vec![1.0; len])
    }

    /// Creates a normaliser with the given moments of `count` observations.
    pub fn from_moments(count: f64, mean: Vec<f64>, variance: Vec<f64>) -> Self {
        let mut normaliser = Self { count, mean, variance, scale: Vec::new() };
        normaliser.update_scale();
        normaliser
    }

    /// Creates a normaliser with the given mean and standard deviation of each entry.
    pub fn from_mean_and_std(mean: &[f32], std: &[f32]) -> Self {
        let mut normaliser = Self::identity(mean.len());
        normaliser.mean = mean.iter().map(|mean| f64::from(*mean)).collect();
        normaliser.variance = std.iter().map(|std| f64::from(*std).powi(2) - VARIANCE_FLOOR).collect();
        normaliser.scale = mean.iter().zip(std).map(|(mean, std)| [*mean, *std]).collect();
        normaliser
    }

    /// Returns the number of entries of an observation.
    pub fn len(&self) -> usize {
        self.mean.len()
    }

    /// Returns true if observations have no entries.
    pub fn is_empty(&self) -> bool {
        self.mean.is_empty()
    }

    /// Returns mean and standard deviation of each entry, as [`Normaliser::apply`] uses them.
    pub fn mean_and_std(&self) -> (Vec<f32>, Vec<f32>) {
        self.scale.iter().map(|[mean, std]| (*mean, *std)).unzip()
    }

    /// Updates the moments with `rows`, observations one after the other.
    pub fn update(&mut self, rows: &[f32]) {
        let len = self.len();
        let count = (rows.len() / len) as f64;
        if count == 0.0 {
            return;
        }
        let mut sums = vec![[0.0f64; 2]; len];
        for row in rows.chunks_exact(len) {
            for ((sum, value), mean) in sums.iter_mut().zip(row).zip(&self.mean) {
                // Relative to the mean so far, so that the difference of squares keeps its digits.
                let offset = f64::from(*value) - mean;
                sum[0] += offset;
                sum[1] += offset * offset;
            }
        }
        let moments = sums.iter().zip(&self.mean).map(|([sum, squares], mean)| {
            let delta = sum / count;
            (mean + delta, (squares / count - delta * delta).max(0.0))
        });
        let (mean, variance) = moments.unzip();
        self.merge(&Self { count, mean, variance, scale: Vec::new() });
    }

    /// Updates the moments with those of other observations.
    ///
    /// Chan, Golub and LeVeque 1979: parallel algorithm for mean and variance.
    pub fn merge(&mut self, other: &Self) {
        let total = self.count + other.count;
        if other.count == 0.0 {
            return;
        }
        let (share, product) = (other.count / total, self.count * other.count / total);
        for entry in 0..self.len() {
            let delta = other.mean[entry] - self.mean[entry];
            let squares = self.variance[entry] * self.count + other.variance[entry] * other.count;
            self.variance[entry] = (squares + delta * delta * product) / total;
            self.mean[entry] += delta * share;
        }
        self.count = total;
        self.update_scale();
    }

    fn update_scale(&mut self) {
        let scale = |(mean, variance): (&f64, &f64)| [*mean as f32, std(*variance)];
        self.scale = self.mean.iter().zip(&self.variance).map(scale).collect();
    }

    /// Writes the normalised observation `row`, clipped to ±10, to the first entries of `output`.
    pub fn apply(&self, row: &[f32], output: &mut [f32]) {
        for ((value, [mean, std]), output) in row.iter().zip(&self.scale).zip(output) {
            *output = ((value - mean) / std).clamp(-CLIP, CLIP);
        }
    }
}

fn std(variance: f64) -> f32 {
    (variance + VARIANCE_FLOOR).sqrt() as f32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn moments_do_not_depend_on_how_the_observations_are_divided(
            values in prop::collection::vec(-100.0f32..100.0, 4..60), cut in 1..3usize,
        ) {
            let rows = &values[..values.len() / 2 * 2];
            let (mut whole, mut parts) = (Normaliser::identity(2), Normaliser::identity(2));
            whole.update(rows);
            parts.update(&rows[..2 * cut.min(rows.len() / 2)]);
            parts.update(&rows[2 * cut.min(rows.len() / 2)..]);
            for entry in 0..2 {
                let column: Vec<f64> = rows.chunks_exact(2).map(|row| f64::from(row[entry])).collect();
                let mean = column.iter().sum::<f64>() / column.len() as f64;
                let variance = column.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / column.len() as f64;
                for normaliser in [&whole, &parts] {
                    prop_assert!((normaliser.mean[entry] - mean).abs() < 1e-6);
                    prop_assert!((normaliser.variance[entry] - variance).abs() < 1e-4);
                }
            }
        }
    }

    #[test]
    fn normalised_entries_have_mean_zero_and_are_clipped() {
        let mut normaliser = Normaliser::identity(1);
        normaliser.update(&[1.0, 3.0]);
        let mut output = [f32::NAN];
        for (value, expected) in [(2.0, 0.0), (3.0, 1.0), (1e6, 10.0), (-1e6, -10.0)] {
            normaliser.apply(&[value], &mut output);
            assert!((output[0] - expected).abs() < 1e-6);
        }
    }
}
