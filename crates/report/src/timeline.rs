//! The time axis of a log: its parts one after another, without the pauses.

use std::ops::Range;

/// Points a line, at most; a panel is a few hundred pixels wide.
const MAX_POINTS: usize = 800;

/// Rows of a log in time.
pub struct Timeline<'a> {
    parts: &'a [Range<usize>],
    /// Time of each row: recorded in the first part, and counted on from there [s].
    time: Vec<f64>,
    /// Rows that share two points of a line.
    rows_per_bucket: usize,
}

impl<'a> Timeline<'a> {
    /// Rows at the times `t` [s], in `parts` that follow one another.
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

    /// From the first row to the last [s].
    pub fn range(&self) -> Range<f64> {
        let first = self.time.first().copied().unwrap_or(0.0);
        first..self.time.last().copied().unwrap_or(first)
    }

    /// The points of each part's line, thinned to the lowest and the highest of each bucket, which keeps every peak.
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
    fn thinned_line_keeps_its_peak_and_time_never_goes_back() {
        // The second part starts over, as a log's episodes may.
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
