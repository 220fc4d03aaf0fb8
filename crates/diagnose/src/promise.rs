//! The promise of a diagnosis: by how much the extended model reduces the position error of a motion, before it is measured.
//!
//! The held-out rows are the last fifth of each motion, and no row of them was fitted. The four fifths before are like them. In each, the
//! given and the extended model have an error: the part of all motions, or of a joint or a motion, gives one ratio of both. The logarithm
//! of a fifth ratio is distributed around the mean of the four with their variance (Student's t).
//!
//! Parameters are fitted to torques, so that a ratio of positions is hardly better where they were fitted. Where positions are fitted, it
//! is, by the few parameters of the causes.

use std::collections::BTreeMap;
use std::ops::Range;

use twinstep_identify::evaluate::position_errors;
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout};

use super::findings::{Promise, Reduction};
use super::{ExperimentError, data_split};

/// Parts of the fitted rows of a motion, as long as the held-out one.
const PARTS: usize = data_split::PARTS - 1;
/// 95 % quantiles of Student's t with one, two and three degrees of freedom.
const STUDENT_95: [f64; PARTS - 1] = [6.314, 2.920, 2.353];

/// Rows and errors of each joint in a log.
type Errors = Vec<Vec<(usize, f64)>>;

/// Predicts the reduction on the held-out rows of logs, and compares it with what is found there; `None` if no positions are compared.
///
/// `models` are the given and the extended one, `names` those of the joints.
pub fn promise(
    logs: &[Log],
    held_out: &[Vec<bool>],
    models: [&RobotModel; 2],
    names: &[String],
    simulator: &mut dyn Rollout,
) -> Result<Option<Promise>, ExperimentError> {
    let mut errors = |robot: &RobotModel| -> Result<Vec<Errors>, ExperimentError> {
        logs.iter().map(|log| Ok(position_errors(log, robot, simulator, |_| true)?.to_vec())).collect()
    };
    let [given, extended] = models;
    let errors = [errors(given)?, errors(extended)?];
    let motions = motions(logs);
    let cells: Vec<Cell> = (0..motions.len())
        .flat_map(|motion| (0..names.len()).map(move |joint| (motion, joint)))
        .map(|(motion, joint)| Cell::new((motion, joint), &motions[motion].1, held_out, &errors))
        .collect();
    let Some(all) = reduction(cells.iter()) else { return Ok(None) };
    let of_joint = |(joint, name): (usize, &String)| {
        Some((name.clone(), reduction(cells.iter().filter(|cell| cell.joint == joint))?))
    };
    let of_motion = |(motion, (name, _)): (usize, &(String, Motion))| {
        Some((name.clone(), reduction(cells.iter().filter(|cell| cell.motion == motion))?))
    };
    let by_joint = names.iter().enumerate().filter_map(of_joint).collect();
    let by_motion = motions.iter().enumerate().filter_map(of_motion).collect();
    Ok(Some(Promise { all, by_joint, by_motion }))
}

/// Rows of one motion: ranges of rows, each of a log.
type Motion = Vec<(usize, Range<usize>)>;

/// Returns name and rows of each motion.
fn motions(logs: &[Log]) -> Vec<(String, Motion)> {
    let mut motions: BTreeMap<String, Motion> = BTreeMap::new();
    for (index, log) in logs.iter().enumerate() {
        for (segment, rows) in log.segments() {
            motions.entry(segment.name.clone()).or_default().push((index, rows));
        }
    }
    motions.into_iter().collect()
}

/// Sums of the squared errors of the given and the extended model [rad²].
type Squares = [f64; 2];

/// A joint in a motion.
#[derive(Clone, Debug)]
struct Cell {
    motion: usize,
    joint: usize,
    /// In each part of the fitted rows.
    parts: [Squares; PARTS],
    /// In the held-out rows.
    held_out: Squares,
}

impl Cell {
    fn new((index, joint): (usize, usize), motion: &Motion, held_out: &[Vec<bool>], models: &[Vec<Errors>; 2]) -> Self {
        let squares = |is_held_out: bool| {
            [0, 1].map(|model| {
                of_motion(&models[model], joint, motion, |log, row| held_out[log][row] == is_held_out)
                    .into_iter()
                    .map(|error| error * error)
                    .collect::<Vec<_>>()
            })
        };
        let [given, extended] = squares(false);
        let sum = |rows: &[f64]| rows.iter().sum::<f64>();
        let part = |part: usize| {
            let rows = part * given.len() / PARTS..(part + 1) * given.len() / PARTS;
            [sum(&given[rows.clone()]), sum(&extended[rows])]
        };
        Self {
            motion: index,
            joint,
            parts: std::array::from_fn(part),
            held_out: squares(true).map(|squares| sum(&squares)),
        }
    }
}

/// Returns the errors of a joint in the rows of a motion, those that are kept by log and row.
fn of_motion(errors: &[Errors], joint: usize, motion: &Motion, is_kept: impl Fn(usize, usize) -> bool) -> Vec<f64> {
    let of_range = |(log, rows): &(usize, Range<usize>)| {
        let errors = &errors[*log][joint];
        let [start, end] = [rows.start, rows.end].map(|row| errors.partition_point(|(at, _)| *at < row));
        let kept = errors[start..end].iter().filter(|(row, _)| is_kept(*log, *row));
        kept.map(|(_, error)| *error).collect::<Vec<_>>()
    };
    motion.iter().flat_map(of_range).collect()
}

/// Returns the predicted and the found reduction of the error of some cells; `None` if too few parts have one.
fn reduction<'a>(cells: impl Iterator<Item = &'a Cell> + Clone) -> Option<Reduction> {
    let log_ratio = |of: &dyn Fn(&Cell) -> Squares| {
        let [given, extended] = cells.clone().map(of).fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]]);
        (given > 0.0 && extended > 0.0).then(|| (extended / given).ln())
    };
    let parts: Vec<f64> = (0..PARTS).filter_map(|part| log_ratio(&|cell| cell.parts[part])).collect();
    let found = log_ratio(&|cell| cell.held_out)?;
    let count = parts.len() as f64;
    let quantile = STUDENT_95.get(parts.len().checked_sub(2)?)?;
    let mean = parts.iter().sum::<f64>() / count;
    let variance = parts.iter().map(|ratio| (ratio - mean).powi(2)).sum::<f64>() / (count - 1.0);
    let half = quantile * (variance * (1.0 + 1.0 / count)).sqrt();
    // The ratio is that of squares.
    let [predicted, low, high, found] = [mean, mean + half, mean - half, found].map(|ratio| 1.0 - (0.5 * ratio).exp());
    Some(Reduction { predicted, interval: [low, high], found })
}

#[cfg(test)]
mod tests {
    use twinstep_model::{standard_normal, stream};

    use super::*;

    /// Returns a joint in a log of 8 fitted and 2 held-out rows, from the errors of the given and the extended model.
    fn cell(given: impl Fn(usize) -> f64, extended: impl Fn(usize) -> f64) -> Cell {
        let held_out: Vec<bool> = (0..10).map(|row| row >= 8).collect();
        let errors = |of: &dyn Fn(usize) -> f64| vec![vec![(0..10).map(|row| (row, of(row))).collect::<Vec<_>>()]];
        Cell::new((0, 0), &vec![(0, 0..10)], &[held_out], &[errors(&given), errors(&extended)])
    }

    #[test]
    fn same_ratio_in_all_parts_is_promised_exactly() {
        let cell = cell(|row| 2.0 + row as f64, |row| 0.5 * (2.0 + row as f64));
        let found = reduction([cell].iter()).expect("errors");
        assert!((found.predicted - 0.5).abs() < 1e-9 && (found.found - 0.5).abs() < 1e-9, "{found:?}");
        assert!((found.interval[1] - found.interval[0]).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn model_that_is_worse_in_the_fitted_rows_promises_a_larger_error() {
        let found = reduction([cell(|_| 1.0, |row| if row % 4 < 2 { 1.5 } else { 1.2 })].iter()).expect("errors");
        assert!(found.predicted < 0.0 && found.interval[1] > found.predicted, "{found:?}");
    }

    #[test]
    fn ninety_percent_of_further_ratios_are_within_the_interval() {
        let mut random = stream(1, "ratios", 0);
        let mut within = 0;
        for _ in 0..500 {
            let mut squares = || [1.0, (0.3 * standard_normal(&mut random) - 1.0).exp()];
            let cell = Cell { motion: 0, joint: 0, parts: std::array::from_fn(|_| squares()), held_out: squares() };
            let found = reduction([cell].iter()).expect("errors");
            within += usize::from((found.interval[0]..found.interval[1]).contains(&found.found));
        }
        // Four standard deviations of the count are 27.
        assert!((423..=477).contains(&within), "{within} of 500");
    }
}
