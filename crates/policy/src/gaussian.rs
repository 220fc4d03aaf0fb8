//! Independent normal distributions of the entries of an action.

use rand::{Rng, RngExt};

/// ln √(2π).
const LN_SQRT_TAU: f32 = 0.918_938_5;

/// Returns the logarithm of the density of `action` [nat], given mean and logarithm of the standard deviation.
pub fn log_probability(action: &[f32], mean: &[f32], log_std: &[f32]) -> f32 {
    let entries = action.iter().zip(mean).zip(log_std);
    entries
        .map(|((action, mean), log_std)| {
            let z = (action - mean) * (-log_std).exp();
            -0.5 * z * z - log_std - LN_SQRT_TAU
        })
        .sum()
}

/// Returns the entropy [nat].
pub fn entropy(log_std: &[f32]) -> f32 {
    log_std.iter().map(|log_std| log_std + 0.5 + LN_SQRT_TAU).sum()
}

/// Fills `values` with samples of the standard normal distribution (Box–Muller method).
pub fn fill_standard_normal(random: &mut impl Rng, values: &mut [f32]) {
    for pair in values.chunks_mut(2) {
        let (u, v): (f32, f32) = (random.random(), random.random());
        let radius = (-2.0 * (1.0 - u).ln()).sqrt();
        let (sin, cos) = (std::f32::consts::TAU * v).sin_cos();
        pair[0] = radius * cos;
        if let Some(second) = pair.get_mut(1) {
            *second = radius * sin;
        }
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;

    #[test]
    fn density_is_that_of_the_textbook() {
        // N(1, 2²) at 3: exp(−½) / (2 √(2π)) = 0.12098536.
        let density = log_probability(&[3.0], &[1.0], &[2f32.ln()]).exp();
        assert!((density - 0.120_985_36).abs() < 1e-7, "{density}");
        assert!((entropy(&[0.0]) - 1.418_938_5).abs() < 1e-6, "½ ln(2πe)");
    }

    #[test]
    fn samples_have_the_moments_of_the_standard_normal_distribution() {
        let mut values = vec![0.0; 200_001];
        fill_standard_normal(&mut stream(1, "test", 0), &mut values);
        let moment = |power: i32| values.iter().map(|value| f64::from(*value).powi(power)).sum::<f64>() / 200_001.0;
        // Standard errors: 0.0022, 0.0032, 0.022.
        assert!(moment(1).abs() < 0.01 && (moment(2) - 1.0).abs() < 0.015 && (moment(4) - 3.0).abs() < 0.1);
    }
}
