//! The normal distribution, above a bound.

/// Deviation below which the tail's series is exact enough.
const TAIL: f64 = -4.0;

/// Returns the logarithm of the probability that a standard normal value is below `x`, to 1 %.
///
/// Abramowitz and Stegun, 7.1.26, and for far tails 26.2.12.
pub fn log_cdf(x: f64) -> f64 {
    if x < TAIL {
        let square = x * x;
        return -0.5 * square - (-x * (std::f64::consts::TAU).sqrt()).ln()
            + (-1.0 / square + 3.0 / square.powi(2)).ln_1p();
    }
    let z = x.abs() / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let series = [1.061_405_429, -1.453_152_027, 1.421_413_741, -0.284_496_736, 0.254_829_592];
    let upper = 0.5 * series.iter().fold(0.0, |sum, term| (sum + term) * t) * (-z * z).exp();
    (if x < 0.0 { upper } else { 1.0 - upper }).ln()
}

/// Returns by how much the evidence of unknowns changes because none is below its bound [nat].
///
/// Each has its mean and standard deviation given the log, and the standard deviation of its prior around zero. The prior has no density
/// below the bound, so that it has more above.
pub fn log_above(least: f64, mean: f64, std: f64, prior_std: f64) -> f64 {
    log_cdf((mean - least) / std.max(1e-12)) - log_cdf(-least / prior_std)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_of_probabilities_are_those_of_tables() {
        for (x, expected) in [(0.0, 0.5), (1.0, 0.841_345), (-1.0, 0.158_655), (-3.0, 1.349_9e-3), (-6.0, 9.866e-10)] {
            assert!((log_cdf(x) - f64::ln(expected)).abs() < 0.01, "{x}: {}", log_cdf(x).exp());
        }
    }

    #[test]
    fn what_a_log_does_not_show_changes_nothing() {
        assert!(log_above(0.0, 0.0, 1.0, 1.0).abs() < 1e-6);
        assert!((log_above(0.0, 10.0, 1.0, 100.0) - std::f64::consts::LN_2).abs() < 1e-6);
        assert!(log_above(0.0, -3.0, 1.0, 100.0) < -5.0);
    }
}
