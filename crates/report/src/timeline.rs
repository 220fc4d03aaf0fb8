//! Time axis of a log: its contiguous ranges one after another, without pauses.

use std::ops::Range;

/// Maximum number of points per line. A panel is a few hundred pixels wide.
const MAX_POINTS: usize = 800;

/// Time axis of the rows of a log.
pub struct Timeline<'a> {
    parts: &'a [Range<usize>],
    /// Time of each row [s]: as recorded in the first part, and continued without pauses in the others.
    time: Vec<f64>,
    /// Number of rows that are reduced to two points of a line.
    rows_per_bucket: usize,
}

impl<'a> Timeline<'a> {
    /// Creates the time axis of rows with times `t` [s], in consecutive ranges `parts`.
    pub fn new(t: &[f64], parts: &'a [Range<usize>]) -> Self {
        let mut time = Vec::with_capacity(t.len());
        let mut now = t.first().copied().unwrap_or(0.0);
        for part in parts {
            let t = &t[part.clone()];
            time.extend(t.iter().map(|t_row| now + t_row - t[0]));
            now = time.last().copied().unwrap_or(now);
        }
        let rows_per_bucket = if time.len() <= MAX_POINTS { 1 } else { (2 * time.len()).div_ceil(MAX_POINTS) };
        Self { parts, time, rows_per_bucket }
    }

    /// Returns the time from the first to the last row [s].
    pub fn range(&self) -> Range<f64> {
        let first = self.time.first().copied().unwrap_or(0.0);
        first..self.time.last().copied().unwrap_or(first)
    }

    /// Returns the points of each part's line, reduced to the minimum and maximum of each bucket. Peaks are kept.
    pub fn points(&self, values: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let by_value = |a: &usize, b: &usize| values[*a].total_cmp(&values[*b]);
        let bucket_points = |bucket: Range<usize>| {
            let lowest = bucket.clone().min_by(by_value).unwrap_or(bucket.start);
            let highest = bucket.clone().max_by(by_value).unwrap_or(bucket.start);
            let mut rows = vec![lowest.min(highest), lowest.max(highest)];
            rows.dedup();
            rows.into_iter().map(|row| (self.time[row], values[row]))
        };
        let line = |part: &Range<usize>| {
            let starts = part.clone().step_by(self.rows_per_bucket);
            starts.flat_map(|start| bucket_points(start..part.end.min(start + self.rows_per_bucket))).collect()
        };
        self.parts.iter().map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinned_line_keeps_its_peak_and_time_is_monotonic() {
        // Time starts again in the second part, as it may in the episodes of a log.
        let t: Vec<f64> = (0..10_000).map(|row| f64::from(row % 5_000) * 0.005).collect();
        let parts = [0..5_000, 5_000..10_000];
        let mut values = vec![0.0; 10_000];
        values[7_003] = 1.0;
        let points = Timeline::new(&t, &parts).points(&values).concat();
        assert!(points.len() <= MAX_POINTS);
        assert!(points.iter().any(|(_, value)| *value == 1.0));
        assert!(points.is_sorted_by(|a, b| a.0 <= b.0));
    }
}
