//! How often the truth lies where an ensemble says it does.

use crate::data::{Split, DataSet, Sequence};
use crate::ensemble::{Ensemble, Gaussian};

/// Shares that central intervals claim to cover.
const NOMINAL_LEVELS: [f64; 3] = [0.5, 0.9, 0.95];
/// Steps of the search for the best variance scale, each of which narrows it to 0.62 of what it was.
const SEARCH_STEPS: usize = 30;
/// Logarithms of the least and the largest of these scales.
const LOG_SCALES: (f64, f64) = (-4.0, 8.0);

/// How far the truth is from where it was expected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// Shares of the truth inside the central 50, 90 and 95 % intervals.
    pub empirical: [f64; 3],
    /// Largest distance of the distribution of the truth's quantiles (PIT) from the even one it should have (Kolmogorov).
    pub pit_ks_statistic: f64,
    /// Mean negative log-likelihood [nat, of torque in N·m].
    pub nll: f64,
}

/// How well the uncertainty of an ensemble is calibrated on rows it has not learnt from.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Rows that were judged by.
    pub rows: usize,
    /// Of the mean prediction [N·m].
    pub rmse: f64,
    /// Sharpness: mean standard deviation of the mixture [N·m].
    pub sharpness: f64,
    /// Each member as its network gives it, and after its variances were scaled.
    pub members: Vec<[Coverage; 2]>,
    /// The mixture of all, before and after.
    pub mixture: [Coverage; 2],
}

impl Calibration {
    /// Of `ensemble` on the blocks of `data` that are neither learnt from nor stopped or scaled by.
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

/// The factor on all variances that gives the validation rows the highest likelihood under the mixture.
pub fn variance_scale(ensemble: &Ensemble, data: &DataSet) -> f64 {
    Predictions::of(ensemble, data, Split::Validation).best_scale(ensemble.description.members)
}

/// Truth, and what each member expected, row by row.
struct Predictions {
    rows: Vec<(f64, Vec<Gaussian>)>,
}

impl Predictions {
    fn of(ensemble: &Ensemble, data: &DataSet, block: Split) -> Self {
        let expected = ensemble.predict(data.runs(block));
        let row = |(run, rows): (&Sequence, Vec<Vec<Gaussian>>)| {
            let unseen = run.torques.len() - rows.len();
            run.torques[unseen..].iter().copied().zip(rows).collect::<Vec<_>>()
        };
        Self { rows: data.runs(block).zip(expected).flat_map(row).collect() }
    }

    /// By golden sections: the likelihood has one peak, or peaks so close that either will do.
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

    /// Of the mixture of some members.
    fn coverage(&self, members: std::ops::Range<usize>) -> Coverage {
        let quantile = |(torque, all): &(f64, Vec<Gaussian>)| mixture_cdf(&all[members.clone()], *torque);
        let mut quantiles: Vec<f64> = self.rows.iter().map(quantile).collect();
        quantiles.sort_by(f64::total_cmp);
        let count = quantiles.len() as f64;
        let inside = |claimed: f64| {
            quantiles.iter().filter(|quantile| (*quantile - 0.5).abs() <= 0.5 * claimed).count() as f64 / count
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

/// Probability of less than `torque`.
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

    /// Truth with a deviation of 2 that members of one mean believe to be `believed`.
    fn predictions(believed: f64) -> Predictions {
        let mut random = stream(4, "truth", 0);
        let row = |_| {
            (1.0 + 2.0 * standard_normal(&mut random), vec![Gaussian { mean: 1.0, variance: believed * believed }; 3])
        };
        Predictions { rows: (0..20_000).map(row).collect() }
    }

    #[test]
    fn true_beliefs_cover_what_they_claim_and_narrow_ones_less() {
        let right = predictions(2.0).coverage(0..3);
        for (share, claimed) in right.empirical.into_iter().zip(NOMINAL_LEVELS) {
            // Three deviations of a share of 20,000.
            assert!((share - claimed).abs() < 0.011, "{share} of {claimed}");
        }
        assert!(right.pit_ks_statistic < 0.012);
        let narrow = predictions(1.0).coverage(0..3);
        // Within 1.645 · 1 of a truth that is spread by 2.
        assert!((narrow.empirical[1] - 0.589).abs() < 0.011, "{:?}", narrow.empirical);
        assert!(narrow.pit_ks_statistic > 0.1 && narrow.nll > right.nll);
        assert!((right.nll - (0.5 + (2.0 * std::f64::consts::TAU.sqrt()).ln())).abs() < 0.02);
    }

    #[test]
    fn best_scale_makes_narrow_beliefs_true() {
        let scale = predictions(1.0).best_scale(3);
        assert!((scale - 4.0).abs() < 0.15, "{scale}");
    }

    #[test]
    fn mixture_of_two_has_the_moments_and_quantiles_of_their_mean() {
        let two = [Gaussian { mean: -1.0, variance: 0.25 }, Gaussian { mean: 3.0, variance: 1.0 }];
        assert_eq!(mixture_mean(&two), 1.0);
        assert_eq!(mixture_variance(&two), 0.625 + 4.0);
        assert!((mixture_cdf(&two, -1.0) - 0.5 * (0.5 + 3.167e-5)).abs() < 1e-8);
        assert!((mixture_cdf(&two, 3.0) - 0.75).abs() < 1e-12);
    }
}
