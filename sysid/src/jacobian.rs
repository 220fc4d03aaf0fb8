//! How residuals change with the unknowns: central differences, all candidates in one batch.

use nalgebra::{DMatrix, DVector};
use twinstep_model::{ModelFile, Rollout};

use crate::experiment::Experiment;
use crate::unknown::{Unknown, candidate};

/// Half a difference, in prior standard deviations.
const STEP: f64 = 0.02;

/// Residuals at a point, and their derivatives by the coordinates in units of their prior deviations.
pub struct Linear {
    /// Residuals.
    pub residuals: DVector<f64>,
    /// One row a residual, one column an unknown.
    pub slopes: DMatrix<f64>,
}

/// Residuals of candidates, one after the other; none of a candidate that is no robot or diverged.
pub fn residuals(
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    file: &ModelFile,
    unknowns: &[Unknown],
    points: &[Vec<f64>],
) -> Vec<Option<Vec<f64>>> {
    let robots: Vec<_> = points.iter().map(|point| candidate(file, unknowns, point)).collect();
    let built: Vec<_> = robots.iter().flatten().cloned().collect();
    let mut parts: Vec<std::vec::IntoIter<Vec<f64>>> =
        experiments.iter().map(|experiment| experiment.residuals(simulator, &built).into_iter()).collect();
    robots
        .iter()
        .map(|robot| {
            robot.as_ref()?;
            let whole: Vec<f64> = parts.iter_mut().flat_map(|part| part.next().unwrap_or_default()).collect();
            whole.iter().all(|residual| residual.is_finite()).then_some(whole)
        })
        .collect()
}

/// Residuals and slopes at `point`; none where a neighbour diverges.
pub fn linear(
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    file: &ModelFile,
    unknowns: &[Unknown],
    point: &[f64],
) -> Option<Linear> {
    let mut points = vec![point.to_vec()];
    let mut widths = Vec::new();
    for (index, unknown) in unknowns.iter().enumerate() {
        let [low, high] = unknown.coordinate_bounds();
        let ends = [-1.0, 1.0].map(|side| (point[index] + side * STEP * unknown.prior[1]).clamp(low, high));
        widths.push((ends[1] - ends[0]) / unknown.prior[1]);
        for end in ends {
            let mut moved = point.to_vec();
            moved[index] = end;
            points.push(moved);
        }
    }
    let mut all = residuals(experiments, simulator, file, unknowns, &points).into_iter();
    let here = DVector::from_vec(all.next()??);
    let mut slopes = DMatrix::zeros(here.len(), unknowns.len());
    for (index, width) in widths.into_iter().enumerate() {
        let (below, above) = (all.next()??, all.next()??);
        let slope =
            DVector::from_iterator(here.len(), above.iter().zip(&below).map(|(above, below)| (above - below) / width));
        slopes.set_column(index, &slope);
    }
    Some(Linear { residuals: here, slopes })
}
