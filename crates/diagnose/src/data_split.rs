//! Assignment of the rows of a log: two folds for selection and fits, and held-out blocks of another regime.
//!
//! The last fifth of every contiguous range is held out, with a gap before it: the end of a chirp is faster than its
//! beginning, and a later part of a schedule has other motions. Seconds that alternate with fitted ones would only
//! measure interpolation. Of ranges that are too short to divide, every fifth is held out as a whole.

use twinstep_logs::Log;

/// Longest block [s]; blocks are assigned to the two folds alternately. Windows with a fixed base are as long.
const LONGEST_BLOCK_S: f64 = 2.0;
/// Shortest block [s].
const SHORTEST_BLOCK_S: f64 = 0.25;
/// Least number of blocks of a log whose blocks are not the shortest: with fewer, random signs are too often all equal.
const LEAST_BLOCKS: f64 = 10.0;
/// Length of a range from which its end is held out [s].
const DIVIDED_S: f64 = 5.0;
/// Length of the gap before a held-out block [s].
const GAP_S: f64 = 0.5;
/// Every so-many-th part of the rows is held out.
pub const PARTS: usize = 5;

/// Role of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    /// Block with this number; even blocks are the first fold, odd ones the second.
    Block(usize),
    HeldOut,
    /// Between fitted and held-out rows, so that they share no transient.
    Gap,
}

/// Role of each row of a log.
#[derive(Clone, Debug)]
pub struct DataSplit {
    parts: Vec<Part>,
}

impl DataSplit {
    /// Divides the rows of `log`.
    pub fn new(log: &Log) -> Self {
        let divided = Self::with_held_out_ends(log, DIVIDED_S);
        let holds_out = divided.parts.contains(&Part::HeldOut);
        if holds_out { divided } else { Self::with_held_out_ends(log, 0.0) }
    }

    /// Holds out the ends of ranges of at least `least` seconds, and every fifth of the shorter ones.
    fn with_held_out_ends(log: &Log, least: f64) -> Self {
        let rate = log.meta().rate_hz;
        let in_rows = |seconds: f64| (seconds * rate).round().max(1.0) as usize;
        let fitted_s = 0.8 * log.rows() as f64 / rate;
        let block = in_rows((fitted_s / LEAST_BLOCKS).clamp(SHORTEST_BLOCK_S, LONGEST_BLOCK_S));
        let (mut parts, mut blocks, mut short) = (vec![Part::Gap; log.rows()], 0, 0);
        for (_, rows) in log.segments() {
            let is_short = (rows.len() as f64) < least * rate;
            short += usize::from(is_short);
            if is_short && short % PARTS == 0 {
                parts[rows].fill(Part::HeldOut);
                continue;
            }
            let held_out = if is_short { 0 } else { rows.len() / PARTS };
            let gap = if is_short { 0 } else { in_rows(GAP_S).min(rows.len() / 20) };
            let first_held_out = rows.end - held_out;
            let end = first_held_out - gap;
            parts[first_held_out..rows.end].fill(Part::HeldOut);
            for start in (rows.start..end).step_by(block) {
                parts[start..end.min(start + block)].fill(Part::Block(blocks));
                blocks += 1;
            }
        }
        Self { parts }
    }

    /// Returns the fold of a row; `None` for rows that take no part in any selection or fit.
    pub fn fold(&self, row: usize) -> Option<usize> {
        self.block(row).map(|block| block % 2)
    }

    /// Returns the block of a row; `None` for rows that take no part in any selection or fit.
    fn block(&self, row: usize) -> Option<usize> {
        match self.parts[row] {
            Part::Block(block) => Some(block),
            Part::HeldOut | Part::Gap => None,
        }
    }

    /// Returns true if a row is held out.
    pub fn is_held_out(&self, row: usize) -> bool {
        self.parts[row] == Part::HeldOut
    }
}

/// Returns for each row of a log whether it takes part in selections and fits.
pub fn fitted_rows(log: &Log) -> Vec<bool> {
    let split = DataSplit::new(log);
    (0..log.rows()).map(|row| !split.is_held_out(row)).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;

    use super::*;

    const RATE_HZ: f64 = 10.0;

    /// Returns a log of episodes with these lengths [s].
    fn log(lengths: &[usize]) -> Log {
        let episodes = lengths.iter().enumerate().flat_map(|(episode, length)| vec![episode as f64; 10 * length]);
        let episodes: Vec<f64> = episodes.collect();
        let rows = episodes.len();
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..rows).map(of).collect());
        let columns = [
            column("t", &|row| row as f64 / RATE_HZ),
            column("q_FL_hip", &|_| 0.0),
            column("q_cmd_FL_hip", &|_| 0.0),
            column("kp", &|_| 20.0),
            column("kd", &|_| 0.5),
            ("episode".to_owned(), episodes),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        Log::new(Meta::new(RATE_HZ, TorqueSensor::None, segments), columns).expect("a log")
    }

    #[test]
    fn last_fifth_of_a_range_is_held_out_with_a_gap() {
        let split = DataSplit::new(&log(&[20]));
        let held_out: Vec<usize> = (0..200).filter(|row| split.is_held_out(*row)).collect();
        assert_eq!((held_out[0], held_out.len()), (160, 40));
        assert!((155..200).all(|row| split.fold(row).is_none()), "0.5 s before it belong to no fold");
        // 16 s in ten blocks.
        let folds: Vec<_> = [0, 15, 16, 31, 32, 154].map(|row| split.fold(row)).to_vec();
        assert_eq!(folds, [Some(0), Some(0), Some(1), Some(1), Some(0), Some(1)]);
    }

    #[test]
    fn every_fifth_short_range_is_held_out() {
        let split = DataSplit::new(&log(&[3; 10]));
        let held_out: Vec<usize> = (0..10).filter(|range| split.is_held_out(30 * range)).collect();
        assert_eq!(held_out, [4, 9]);
        assert!(split.fold(0).is_some() && split.fold(29).is_some());
    }

    #[test]
    fn log_of_one_short_range_holds_out_its_end() {
        let split = DataSplit::new(&log(&[4]));
        assert!(split.is_held_out(39) && split.fold(0) == Some(0));
    }
}
