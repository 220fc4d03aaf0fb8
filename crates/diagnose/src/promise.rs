//! The promise of a diagnosis: by how much the extended model reduces the position error of a motion, before it is measured.
//!
//! How far the given and the extended model are from each other, `d`, is known for any motion: both are simulated. The error of the
//! extended model is `c · d + u`: a share of the correction that is wrong, and what neither model has. Both are measured where the model
//! was fitted ([`Left`]), for each motion and joint, in parts as long as the held-out one. A further part differs from their mean as they
//! differ from each other (Student's t). The error of the given model is then `(1 + c) · d + u`.
//!
//! Errors of the fitted parameters are part of `c`: these explain the torques of the fitted rows, not their positions.

use std::collections::BTreeMap;
use std::ops::Range;

use twinstep_identify::evaluate::position_errors;
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout, Stream, standard_normal, stream};

use super::ExperimentError;
use super::findings::{Promise, Reduction};

/// Further parts that are drawn.
const DRAWS: usize = 500;
/// Parts of the fitted rows of a motion: the held-out rows are a fifth of all.
const PARTS: usize = 4;

/// Largest scale of deviations.
const LARGEST: f64 = 5.0;
/// Square that is no error [rad²].
const LEAST: f64 = 1e-14;

/// Rows and errors of each joint in a log.
type Errors = Vec<Vec<(usize, f64)>>;

/// Predicts the reduction on the held-out rows of logs, and compares it with what is found there; `None` if no positions are compared.
///
/// `names` are those of the joints.
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
        .filter(|cell| cell.rows > 0.0)
        .collect();
    if cells.iter().all(|cell| cell.left.is_empty()) {
        return Ok(None);
    }
    let mut random = stream(0, "promise", 0);
    // Squares of the given and of the extended model, by draw and cell.
    let draw = |_| {
        let deviations = deviations(motions.len(), &mut random);
        cells.iter().map(|cell| cell.predicted(&deviations[cell.motion])).collect()
    };
    let draws: Vec<Vec<[f64; 2]>> = (0..DRAWS).map(draw).collect();
    let reduction = |is_of: &dyn Fn(&Cell) -> bool| {
        let sums = |squares: &mut dyn Iterator<Item = [f64; 2]>| {
            let [given, extended] = squares.fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]]);
            1.0 - (extended / given.max(f64::MIN_POSITIVE)).sqrt()
        };
        let of_draw = |draw: &Vec<[f64; 2]>| {
            sums(&mut cells.iter().zip(draw).filter(|(cell, _)| is_of(cell)).map(|(_, squares)| *squares))
        };
        let mut all: Vec<f64> = draws.iter().map(of_draw).collect();
        all.sort_by(f64::total_cmp);
        let found = sums(&mut cells.iter().filter(|cell| is_of(cell)).map(|cell| cell.found));
        Reduction { predicted: quantile(&all, 0.5), interval: [quantile(&all, 0.05), quantile(&all, 0.95)], found }
    };
    let by_joint = (0..names.len()).filter(|joint| cells.iter().any(|cell| cell.joint == *joint));
    let by_joint: BTreeMap<String, Reduction> =
        by_joint.map(|joint| (names[joint].clone(), reduction(&|cell| cell.joint == joint))).collect();
    let by_motion = (0..motions.len()).filter(|motion| cells.iter().any(|cell| cell.motion == *motion));
    let by_motion: BTreeMap<String, Reduction> =
        by_motion.map(|motion| (motions[motion].0.clone(), reduction(&|cell| cell.motion == motion))).collect();
    Ok(Some(Promise { all: reduction(&|_| true), by_joint, by_motion }))
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

/// What the extended model leaves in a part of the fitted rows.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Left {
    /// Sum of the squares of the correction [rad²].
    correction: f64,
    /// Product of the correction with what is left [rad²].
    product: f64,
    /// Mean square of what neither model has [rad²].
    square: f64,
}

impl Left {
    /// Measures it from errors of the given and the extended model.
    fn new(given: &[f64], extended: &[f64]) -> Self {
        let pairs = || given.iter().zip(extended).map(|(given, extended)| (given - extended, extended));
        let correction: f64 = pairs().map(|(correction, _)| correction * correction).sum();
        let product: f64 = pairs().map(|(correction, left)| correction * left).sum();
        let wrong = product / correction.max(LEAST);
        let rest: f64 = pairs().map(|(correction, left)| (left - wrong * correction).powi(2)).sum();
        Self { correction, product, square: rest / extended.len().max(1) as f64 }
    }
}

/// How a further part of a motion differs from the mean of the known ones: the same sum of their differences for all joints.
struct Deviation([f64; PARTS]);

impl Deviation {
    /// Returns the value of a further part, given those of the known ones.
    fn value(&self, known: &[f64]) -> f64 {
        let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
        mean + self.0.iter().zip(known).map(|(factor, value)| factor * (value - mean)).sum::<f64>()
    }
}

/// Draws a deviation for each motion. Their variance is that of a further value given some. It is known as from one motion: what a model
/// lacks is alike in all motions of a log.
fn deviations(motions: usize, random: &mut Stream) -> Vec<Deviation> {
    let degrees = PARTS - 1;
    let square: f64 = (0..degrees).map(|_| standard_normal(random).powi(2)).sum();
    let parts = PARTS as f64;
    let scale = ((1.0 + 1.0 / parts) / (parts - 1.0) * degrees as f64 / square.max(f64::MIN_POSITIVE)).sqrt();
    (0..motions).map(|_| Deviation(std::array::from_fn(|_| scale.min(LARGEST) * standard_normal(random)))).collect()
}

/// A joint in a motion.
#[derive(Clone, Debug)]
struct Cell {
    motion: usize,
    joint: usize,
    /// What is left in each part of the fitted rows; empty if there are none.
    left: Vec<Left>,
    /// Number of the held-out rows.
    rows: f64,
    /// Sum of the squares of the correction in them [rad²].
    correction: f64,
    /// Sum of the squared errors of the given and the extended model in them [rad²].
    found: [f64; 2],
}

impl Cell {
    fn new((index, joint): (usize, usize), motion: &Motion, held_out: &[Vec<bool>], models: &[Vec<Errors>; 2]) -> Self {
        let errors = |is_held_out: bool| {
            [0, 1].map(|model| of_motion(&models[model], joint, motion, |log, row| held_out[log][row] == is_held_out))
        };
        let [given, extended] = errors(false);
        let part = |part: usize| part * given.len() / PARTS..(part + 1) * given.len() / PARTS;
        let left = (0..PARTS).map(part).filter(|rows| !rows.is_empty());
        let left = left.map(|rows| Left::new(&given[rows.clone()], &extended[rows])).collect();
        let held_out = errors(true);
        let correction = held_out[0].iter().zip(&held_out[1]).map(|(given, extended)| (given - extended).powi(2)).sum();
        let rows = held_out[0].len() as f64;
        let found = held_out.map(|errors| errors.iter().map(|error| error * error).sum());
        Self { motion: index, joint, left, rows, correction, found }
    }

    /// Returns the squares that are expected of a further part with the correction of the held-out rows.
    fn predicted(&self, deviation: &Deviation) -> [f64; 2] {
        if self.left.is_empty() {
            return [self.correction, 0.0];
        }
        let sums = self.left.iter().fold([0.0; 2], |sum, left| [sum[0] + left.product, sum[1] + left.correction]);
        let usual = sums[0] / sums[1].max(LEAST);
        // The share of a part with a small correction varies more: its product with the correction does not.
        let of_parts = |of: &dyn Fn(&Left) -> f64| deviation.value(&self.left.iter().map(of).collect::<Vec<_>>());
        let product = of_parts(&|left| (left.product - usual * left.correction) / left.correction.max(LEAST).sqrt());
        let wrong = usual + product / self.correction.max(LEAST).sqrt();
        let rest = self.rows * of_parts(&|left| left.square.max(LEAST).ln()).exp();
        [1.0 + wrong, wrong].map(|share| share * share * self.correction + rest)
    }
}

/// Returns a quantile of sorted values.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, part) = (place.floor() as usize, place.fract());
    sorted[below] + part * (sorted[(below + 1).min(sorted.len() - 1)] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a joint in a log of 8 fitted and 8 held-out rows, from the errors of the given and the extended model.
    fn cell(given: impl Fn(usize) -> f64, extended: impl Fn(usize) -> f64) -> Cell {
        let held_out: Vec<bool> = (0..16).map(|row| row >= 8).collect();
        let errors = |of: &dyn Fn(usize) -> f64| vec![vec![(0..16).map(|row| (row, of(row))).collect::<Vec<_>>()]];
        Cell::new((0, 0), &vec![(0, 0..16)], &[held_out], &[errors(&given), errors(&extended)])
    }

    fn sign(row: usize) -> f64 {
        if row.is_multiple_of(2) { 1.0 } else { -1.0 }
    }

    /// No deviation from the mean.
    const MEAN: Deviation = Deviation([0.0; PARTS]);

    #[test]
    fn what_neither_model_has_is_in_both_errors() {
        // The correction is a constant of 3, what neither has is an alternating 4.
        let cell = cell(|row| 3.0 + 4.0 * sign(row), |row| 4.0 * sign(row));
        let predicted = cell.predicted(&MEAN);
        let is_near = |one: f64, other: f64| (one - other).abs() < 1e-9;
        assert!(is_near(predicted[0], 8.0 * 25.0) && is_near(predicted[1], 8.0 * 16.0), "{predicted:?}");
        assert_eq!(cell.found, [8.0 * 25.0, 8.0 * 16.0]);
    }

    #[test]
    fn correction_that_is_wrong_where_it_was_fitted_makes_the_promise_negative() {
        // The measurement is where the given model is.
        let [before, after] = cell(|_| 0.0, |_| 3.0).predicted(&MEAN);
        assert!(before < 1e-9 && (after - 8.0 * 9.0).abs() < 1e-9, "{before} {after}");
    }

    #[test]
    fn ninety_percent_of_further_parts_are_within_the_interval_of_the_drawn_ones() {
        let mut random = stream(1, "parts", 0);
        let mut within = 0;
        for _ in 0..500 {
            let known: [f64; PARTS] = std::array::from_fn(|_| standard_normal(&mut random));
            let further = standard_normal(&mut random);
            let mut drawn: Vec<f64> = (0..400).map(|_| deviations(1, &mut random)[0].value(&known)).collect();
            drawn.sort_by(f64::total_cmp);
            within += usize::from((quantile(&drawn, 0.05)..quantile(&drawn, 0.95)).contains(&further));
        }
        // Four standard deviations of the count are 27.
        assert!((423..=477).contains(&within), "{within} of 500");
    }

    #[test]
    fn quantile_is_between_two_values() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
    }
}
