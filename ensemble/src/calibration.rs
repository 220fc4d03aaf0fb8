//! Calibration of an ensemble's predictive uncertainty.

use crate::data::{DataSet, Sequence, Split};
use crate::ensemble::{Ensemble, Gaussian};

/// Nominal levels of the central prediction intervals.
const NOMINAL_LEVELS: [f64; 3] = [0.5, 0.9, 0.95];
/// Steps of the golden-section search for the variance scale; each reduces the interval to 62 %.
const SEARCH_STEPS: usize = 30;
/// Logarithms of the minimum and maximum variance scale.
const LOG_SCALES: (f64, f64) = (-4.0, 8.0);

/// Calibration of a predictive distribution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// Fractions of the measurements inside the central 50, 90 and 95 % intervals.
    pub empirical: [f64; 3],
    /// Kolmogorov–Smirnov distance of the quantiles (PIT) from the uniform distribution.
    pub pit_ks_statistic: f64,
    /// Mean negative log-likelihood of the torque in N·m [nat].
    pub nll: f64,
}

/// Accuracy and calibration of an ensemble on the test split.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Number of test rows.
    pub rows: usize,
    /// RMS error of the mean prediction [N·m].
    pub rmse: f64,
    /// Mean standard deviation of the mixture distribution [N·m].
    pub sharpness: f64,
    /// Calibration of each member, before and after its variances are scaled.
    pub members: Vec<[Coverage; 2]>,
    /// Calibration of the mixture distribution, before and after the variances are scaled.
    pub mixture: [Coverage; 2],
}

impl Calibration {
    /// Evaluates `ensemble` on the test split of `data`.
    pub fn of(ensemble: &Ensemble, data: &DataSet) -> Self {
        let after = Predictions::of(ensemble, data, Split::Test);
        let before = after.scaled(1.0 / ensemble.description.variance_scale);
        let both = |members: std::ops::Range<usize>| [&before, &after].map(|all| all.coverage(members.clone()));
        let count = ensemble.description.members;
        let errors = after.rows.iter().map(|(torque, members)| (torque - mixture_mean(members)).powi(2));
        let deviations = after.rows.iter().map(|(_, members)| mixture_variance(members).sqrt());
        let rows = after.rows.len();
        Self {
            rows,
            rmse: (errors.sum::<f64>() / rows as f64).sqrt(),
            sharpness: deviations.sum::<f64>() / rows as f64,
            members: (0..count).map(|member| both(member..member + 1)).collect(),
            mixture: both(0..count),
        }
    }
}

/// Returns the variance factor with the highest likelihood of the validation split under the mixture.
pub fn variance_scale(ensemble: &Ensemble, data: &DataSet) -> f64 {
    Predictions::of(ensemble, data, Split::Validation).best_scale(ensemble.description.members)
}

/// Measured torque and the members' predictions, row by row.
struct Predictions {
    rows: Vec<(f64, Vec<Gaussian>)>,
}

impl Predictions {
    fn of(ensemble: &Ensemble, data: &DataSet, block: Split) -> Self {
        let expected = ensemble.predict(data.runs(block));
        let row = |(run, rows): (&Sequence, Vec<Vec<Gaussian>>)| {
            let burn_in = run.torques.len() - rows.len();
            run.torques[burn_in..].iter().copied().zip(rows).collect::<Vec<_>>()
        };
        Self { rows: data.runs(block).zip(expected).flat_map(row).collect() }
    }

    /// Finds the best scale by golden-section search. The likelihood has one maximum, or several close together.
    fn best_scale(&self, members: usize) -> f64 {
        let nll = |log_scale: f64| self.scaled(log_scale.exp()).nll(0..members);
        let (mut low, mut high) = LOG_SCALES;
        let ratio = 0.5 * (5f64.sqrt() - 1.0);
        for _ in 0..SEARCH_STEPS {
            let (left, right) = (high - ratio * (high - low), low + ratio * (high - low));
            if nll(left) < nll(right) { high = right } else { low = left }
        }
        (0.5 * (low + high)).exp()
    }

    fn scaled(&self, factor: f64) -> Self {
        let scaled = |members: &[Gaussian]| {
            members.iter().map(|one| Gaussian { variance: factor * one.variance, ..*one }).collect()
        };
        Self { rows: self.rows.iter().map(|(torque, members)| (*torque, scaled(members))).collect() }
    }

    fn nll(&self, members: std::ops::Range<usize>) -> f64 {
        let sum: f64 = self.rows.iter().map(|(torque, all)| -log_density(&all[members.clone()], *torque)).sum();
        sum / self.rows.len() as f64
    }

    /// Returns the calibration of the mixture of some members.
    fn coverage(&self, members: std::ops::Range<usize>) -> Coverage {
        let quantile = |(torque, all): &(f64, Vec<Gaussian>)| mixture_cdf(&all[members.clone()], *torque);
        let mut quantiles: Vec<f64> = self.rows.iter().map(quantile).collect();
        quantiles.sort_by(f64::total_cmp);
        let count = quantiles.len() as f64;
        let inside = |level: f64| {
            quantiles.iter().filter(|quantile| (*quantile - 0.5).abs() <= 0.5 * level).count() as f64 / count
        };
        let distance = |(index, quantile): (usize, &f64)| {
            (quantile - index as f64 / count).abs().max((quantile - (index + 1) as f64 / count).abs())
        };
        Coverage {
            empirical: NOMINAL_LEVELS.map(inside),
            pit_ks_statistic: quantiles.iter().enumerate().map(distance).fold(0.0, f64::max),
            nll: self.nll(members),
        }
    }
}

fn mixture_mean(members: &[Gaussian]) -> f64 {
    members.iter().map(|member| member.mean).sum::<f64>() / members.len() as f64
}

fn mixture_variance(members: &[Gaussian]) -> f64 {
    let mean = mixture_mean(members);
    let second = |member: &Gaussian| member.variance + (member.mean - mean).powi(2);
    members.iter().map(second).sum::<f64>() / members.len() as f64
}

/// Returns the probability of a torque below `torque`.
fn mixture_cdf(members: &[Gaussian], torque: f64) -> f64 {
    let below = |member: &Gaussian| 0.5 * libm::erfc((member.mean - torque) / (2.0 * member.variance).sqrt());
    members.iter().map(below).sum::<f64>() / members.len() as f64
}

fn log_density(members: &[Gaussian], torque: f64) -> f64 {
    let log = |member: &Gaussian| {
        -0.5 * ((std::f64::consts::TAU * member.variance).ln() + (torque - member.mean).powi(2) / member.variance)
    };
    let largest = members.iter().map(log).fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = members.iter().map(|member| (log(member) - largest).exp()).sum();
    largest + (sum / members.len() as f64).ln()
}

#[cfg(test)]
mod tests {
    use twinstep_model::{standard_normal, stream};

    use super::*;

    /// Measurements with standard deviation 2, for which the members predict `predicted_std`.
    fn predictions(predicted_std: f64) -> Predictions {
        let mut random = stream(4, "truth", 0);
        let row = |_| {
            (
                1.0 + 2.0 * standard_normal(&mut random),
                vec![Gaussian { mean: 1.0, variance: predicted_std * predicted_std }; 3],
            )
        };
        Predictions { rows: (0..20_000).map(row).collect() }
    }

    #[test]
    fn correct_variances_have_nominal_coverage_and_small_ones_less() {
        let correct = predictions(2.0).coverage(0..3);
        for (fraction, level) in correct.empirical.into_iter().zip(NOMINAL_LEVELS) {
            // Tolerance: three standard deviations of a fraction of 20,000 rows.
            assert!((fraction - level).abs() < 0.011, "{fraction} of {level}");
        }
        assert!(correct.pit_ks_statistic < 0.012);
        let narrow = predictions(1.0).coverage(0..3);
        // Probability of |x| < 1.645 for a standard deviation of 2.
        assert!((narrow.empirical[1] - 0.589).abs() < 0.011, "{:?}", narrow.empirical);
        assert!(narrow.pit_ks_statistic > 0.1 && narrow.nll > correct.nll);
        assert!((correct.nll - (0.5 + (2.0 * std::f64::consts::TAU.sqrt()).ln())).abs() < 0.02);
    }

    #[test]
    fn best_scale_corrects_small_variances() {
        let scale = predictions(1.0).best_scale(3);
        assert!((scale - 4.0).abs() < 0.15, "{scale}");
    }

    #[test]
    fn mixture_of_two_has_the_known_moments_and_quantiles() {
        let two = [Gaussian { mean: -1.0, variance: 0.25 }, Gaussian { mean: 3.0, variance: 1.0 }];
        assert_eq!(mixture_mean(&two), 1.0);
        assert_eq!(mixture_variance(&two), 0.625 + 4.0);
        assert!((mixture_cdf(&two, -1.0) - 0.5 * (0.5 + 3.167e-5)).abs() < 1e-8);
        assert!((mixture_cdf(&two, 3.0) - 0.75).abs() < 1e-12);
    }
}
