//! Selection of rows of a log.

use twinstep_logs::Log;

use crate::failure::{Failure, input};

/// Selection of rows of a log by time and segment. Default: all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RowSelection {
    /// Only rows from this time on [s].
    pub from_s: Option<f64>,
    /// Only rows before this time [s].
    pub until_s: Option<f64>,
    /// Only the segments with these names; empty: all.
    pub segments: Vec<String>,
}

/// `--segment` is not a segment of the log.
#[derive(Debug, thiserror::Error)]
#[error("`--segment`: the log has no segment `{given}`; its segments are {segments}")]
struct NoSegment {
    given: String,
    segments: String,
}

/// `--from` and `--until` select no row.
#[derive(Debug, thiserror::Error)]
#[error("`--from`, `--until` and `--segment` select no row: `t` of the log is {first} to {last} s")]
struct NoRows {
    first: f64,
    last: f64,
}

impl RowSelection {
    /// Returns, for each row of the log, whether it is selected.
    pub fn of(&self, log: &Log) -> Result<Vec<bool>, Failure> {
        let (from, until) = (self.from_s.unwrap_or(f64::NEG_INFINITY), self.until_s.unwrap_or(f64::INFINITY));
        let segments: Vec<&str> = log.meta().segments.iter().map(|segment| segment.name.as_str()).collect();
        if let Some(given) = self.segments.iter().find(|given| !segments.contains(&given.as_str())) {
            return Err(input(NoSegment { given: given.clone(), segments: segments.join(", ") }));
        }
        let is_selected = |row: usize| {
            let name = segments[log.segment()[row] as usize];
            self.segments.is_empty() || self.segments.iter().any(|selected| selected == name)
        };
        let in_time = |row: usize| (from..until).contains(&log.t()[row]);
        let rows: Vec<bool> = (0..log.rows()).map(|row| in_time(row) && is_selected(row)).collect();
        if rows.contains(&true) {
            return Ok(rows);
        }
        let (first, last) = (log.t()[0], log.t()[log.rows() - 1]);
        Err(input(NoRows { first, last }))
    }
}
