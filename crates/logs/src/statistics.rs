//! Statistics of a channel.

/// Returns the largest number; ignores NaN.
pub(crate) fn largest(values: impl Iterator<Item = f64>) -> Option<f64> {
    values.filter(|value| !value.is_nan()).reduce(f64::max)
}

/// Returns a quantile of sorted numbers, without interpolation.
pub(crate) fn quantile(sorted: &[f64], fraction: f64) -> Option<f64> {
    let index = (fraction * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(index).copied()
}

/// Returns the standard deviation of numbers.
pub(crate) fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Returns the root mean square; ignores NaN.
pub(crate) fn root_mean_square(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) =
        values.filter(|value| !value.is_nan()).fold((0, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    (count > 0).then(|| (sum / f64::from(count)).sqrt())
}

/// Returns the step of quantised numbers; `None` if they are not quantised. Ignores NaN.
///
/// Numbers are quantised if they repeat, and the gaps between neighbours in value are multiples of the smallest gap within 2 %.
pub(crate) fn quantum(values: &[f64]) -> Option<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let range = sorted.last()? - sorted[0];
    // Rounding of cells in single precision or in text does not separate values.
    let gaps: Vec<f64> = sorted.windows(2).map(|pair| pair[1] - pair[0]).filter(|gap| *gap > 1e-6 * range).collect();
    let smallest = gaps.iter().copied().reduce(f64::min)?;
    let is_multiple = |gap: &&f64| (**gap / smallest - (**gap / smallest).round()).abs() < 0.02 * (**gap / smallest);
    let regular = gaps.iter().filter(is_multiple).count();
    let repeats = gaps.len() * 4 < sorted.len() && gaps.len() >= 4;
    (repeats && regular * 20 >= gaps.len() * 19).then_some(smallest)
}

#[cfg(test)]
mod tests {
    use super::quantum;

    #[test]
    fn step_of_a_quantised_signal_is_found_and_a_smooth_signal_has_none() {
        let smooth: Vec<f64> = (0..4000).map(|row| 0.3 * (f64::from(row) * 0.01).sin()).collect();
        let rounded: Vec<f64> = smooth.iter().map(|value| (value / 0.0015).round() * 0.0015).collect();
        assert!((quantum(&rounded).expect("quantised") - 0.0015).abs() < 1e-9);
        assert_eq!(quantum(&smooth), None);
        assert_eq!(quantum(&[1.0; 50]), None);
        assert_eq!(quantum(&[f64::NAN; 50]), None);
    }
}
