//! R² of a residual that may depend on a variable, cross-validated between the two folds.

use super::data_split::DataSplit;

/// Number of bins of a variable that may explain a residual.
const BINS: usize = 16;

/// Returns the R² of binned means or of a straight line, whichever is larger.
pub fn r_squared(split: &DataSplit, residual: &[f64], cells: &[f64]) -> f64 {
    binned_r_squared(split, residual, cells).max(linear_r_squared(split, residual, cells))
}

/// Returns the R² of a straight line that is fitted to one fold and evaluated on the other.
///
/// Of a variable that only grows, such as time, a bin may have no row of the other fold.
fn linear_r_squared(split: &DataSplit, residual: &[f64], cells: &[f64]) -> f64 {
    let pairs = |fold: usize| {
        let rows = (0..residual.len()).filter(move |row| split.fold(*row) == Some(fold));
        rows.map(|row| (cells[row], residual[row])).filter(|(cell, value)| cell.is_finite() && value.is_finite())
    };
    let (mut rest, mut total) = (0.0, 0.0);
    for fold in [0, 1] {
        let count = pairs(fold).count().max(1) as f64;
        let (x, y) = pairs(fold).fold((0.0, 0.0), |(x, y), (cell, value)| (x + cell / count, y + value / count));
        let (product, square) = pairs(fold).fold((0.0, 0.0), |(product, square), (cell, value)| {
            (product + (cell - x) * (value - y), square + (cell - x).powi(2))
        });
        let slope = product / square.max(1e-30);
        for (cell, value) in pairs(1 - fold) {
            rest += (value - y - slope * (cell - x)).powi(2);
            total += (value - y).powi(2);
        }
    }
    if total > 0.0 { 1.0 - rest / total } else { 0.0 }
}

/// Returns the R² of binned means: bins of `cells`, means from one fold, evaluated on the other.
fn binned_r_squared(split: &DataSplit, residual: &[f64], cells: &[f64]) -> f64 {
    let rows: Vec<usize> =
        (0..residual.len()).filter(|row| residual[*row].is_finite() && cells[*row].is_finite()).collect();
    if rows.len() < 10 * BINS {
        return 0.0;
    }
    let ends = ends_of_bins(&rows, residual, cells);
    let bin = |value: f64| ends.partition_point(|end| *end < value);
    let (mut rest, mut total) = (0.0, 0.0);
    for fold in [0, 1] {
        let (mut sums, mut counts) = ([0.0; BINS], [0.0; BINS]);
        let of_fold = |fold: usize| rows.iter().copied().filter(move |row| split.fold(*row) == Some(fold));
        for row in of_fold(fold) {
            sums[bin(cells[row])] += residual[row];
            counts[bin(cells[row])] += 1.0;
        }
        let mean = sums.iter().sum::<f64>() / counts.iter().sum::<f64>().max(1.0);
        for row in of_fold(1 - fold) {
            let bin = bin(cells[row]);
            let expected = if counts[bin] > 0.0 { sums[bin] / counts[bin] } else { mean };
            rest += (residual[row] - expected).powi(2);
            total += (residual[row] - mean).powi(2);
        }
    }
    if total > 0.0 { 1.0 - rest / total } else { 0.0 }
}

/// Returns the ends of all bins but the last. Each has the same share of the rows and of the power of the residual, added up: a
/// steep law has most of its power in few rows.
fn ends_of_bins(rows: &[usize], residual: &[f64], cells: &[f64]) -> Vec<f64> {
    let power: f64 = rows.iter().map(|row| residual[*row].powi(2)).sum();
    let mut sorted = rows.to_vec();
    sorted.sort_by(|one, other| cells[*one].total_cmp(&cells[*other]));
    let (mut ends, mut mass) = (Vec::new(), 0.0);
    for row in sorted {
        mass += 0.5 / rows.len() as f64 + 0.5 * residual[row].powi(2) / power.max(1e-30);
        if mass * BINS as f64 > (ends.len() + 1) as f64 && ends.len() + 1 < BINS {
            ends.push(cells[row]);
        }
    }
    ends
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_data::log;

    /// Returns the R² of a residual that depends on `cells`, of 20 s.
    fn share(cells: impl Fn(f64) -> f64, residual: impl Fn(f64) -> f64) -> f64 {
        let log = log(|_| 0.0, None);
        let cells: Vec<f64> = log.t().iter().map(|t| cells(*t)).collect();
        let residual: Vec<f64> = cells.iter().map(|cell| residual(*cell)).collect();
        r_squared(&DataSplit::new(&log), &residual, &cells)
    }

    /// A gain that grows with the error: nearly all of its torque is at the ends of the motion.
    #[test]
    fn steep_dependence_is_found_although_few_rows_show_it() {
        let steep = share(|t| (5.3 * t).sin(), |error| error.powi(31));
        assert!(steep > 0.8, "{steep}");
    }

    /// As the height of a foot whose encoder slips.
    #[test]
    fn slow_growth_is_found_although_no_time_returns() {
        assert!(share(|t| t, |t| 1e-3 * t) > 0.999);
    }
}
