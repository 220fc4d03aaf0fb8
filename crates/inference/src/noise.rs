//! Noise of a channel: what simulated and measured positions or torques differ by at the best model.

/// Returns the standard deviation of errors, times the root of the number of rows that count as one. `lengths`: rows of each window.
///
/// A joint that sticks in the wrong place has the same error for seconds. `1 + 2 Σ ρ` rows count as one: the sum of the
/// autocorrelation to its first value below zero (Sokal 1997, eq. 2.11). The estimate stays that of the smallest error, and its
/// interval allows for errors of the model.
pub fn effective_std(errors: &[f64], lengths: &[usize]) -> f64 {
    let variance = covariance(errors, lengths, 0).max(1e-12);
    let longest = lengths.iter().copied().max().unwrap_or(1);
    let correlations = (1..longest).map(|lag| covariance(errors, lengths, lag) / variance);
    let rows_as_one = 1.0 + 2.0 * correlations.take_while(|correlation| *correlation > 0.0).sum::<f64>();
    (variance * rows_as_one).sqrt()
}

/// Returns the mean product of errors that are `lag` rows apart in their window. Missing errors are NaN, and do not count.
fn covariance(errors: &[f64], lengths: &[usize], lag: usize) -> f64 {
    let (mut sum, mut rest) = (0.0, errors);
    for length in lengths {
        let (window, after) = rest.split_at(*length);
        let products = window.iter().zip(&window[lag.min(window.len())..]).map(|(one, other)| one * other);
        sum += products.filter(|product| !product.is_nan()).sum::<f64>();
        rest = after;
    }
    let known = errors.iter().filter(|error| !error.is_nan()).count();
    sum / known.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::effective_std;

    #[test]
    fn missing_errors_do_not_count() {
        let errors: Vec<f64> = (0..1000).map(|row| if row % 10 == 0 { 0.5 } else { f64::NAN }).collect();
        assert!((effective_std(&errors, &[1000]) / 0.5).powi(2) > 0.99);
        let white: Vec<f64> =
            (0..1000).map(|row| if row % 10 == 0 { (row % 20) as f64 / 10.0 - 0.5 } else { f64::NAN }).collect();
        assert!((effective_std(&white, &[1000]) - 0.5).abs() < 0.1, "{}", effective_std(&white, &[1000]));
    }

    #[test]
    fn repeated_errors_count_once() {
        let white: Vec<f64> = (0..4000u64)
            .map(|row| if row.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 63 == 0 { 1.0 } else { -1.0 })
            .collect();
        let repeated: Vec<f64> = white.iter().flat_map(|error| [*error; 10]).collect();
        let (once, ten) = (effective_std(&white, &[2000, 2000]), effective_std(&repeated, &[20_000, 20_000]));
        assert!((once - 1.0).abs() < 0.3, "{once}");
        assert!((ten / once / 10f64.sqrt() - 1.0).abs() < 0.3, "{ten}");
    }
}
