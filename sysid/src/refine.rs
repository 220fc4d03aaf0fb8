//! Levenberg-Marquardt from where the search ended, and the covariance there.

use nalgebra::{DMatrix, DVector};
use twinstep_model::{ModelFile, Rollout};

use crate::experiment::Experiment;
use crate::jacobian::{Linear, linear, residuals};
use crate::unknown::Unknown;

/// Most steps.
const STEPS: usize = 20;
/// Factors of the diagonal that are tried side by side: a step costs one batch.
const DAMPINGS: [f64; 5] = [0.0, 1e-3, 1e-2, 0.1, 1.0];

/// Cost of residuals and of the distance to the prior.
pub fn cost(residuals: &[f64], unknowns: &[Unknown], point: &[f64], scale: f64) -> f64 {
    residuals.iter().map(|residual| residual * residual).sum::<f64>() / scale
        + distances(unknowns, point).map(|distance| distance * distance).sum::<f64>()
}

/// From the prior means, in prior deviations.
fn distances(unknowns: &[Unknown], point: &[f64]) -> impl Iterator<Item = f64> {
    unknowns.iter().zip(point).map(|(unknown, value)| (value - unknown.prior[0]) / unknown.prior[1])
}

/// Goes downhill from `point`; `scale` is the variance of the residuals.
pub fn refine(
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    file: &ModelFile,
    unknowns: &[Unknown],
    mut point: Vec<f64>,
    scale: f64,
    mut each: impl FnMut(f64) -> bool,
) -> Vec<f64> {
    for _ in 0..STEPS {
        let Some(here) = linear(experiments, simulator, file, unknowns, &point) else { break };
        let now = cost(here.residuals.as_slice(), unknowns, &point, scale);
        let tries: Vec<_> =
            DAMPINGS.iter().filter_map(|damping| step(&here, unknowns, &point, scale, *damping)).collect();
        let costs: Vec<f64> = residuals(experiments, simulator, file, unknowns, &tries)
            .iter()
            .zip(&tries)
            .map(|(found, point)| found.as_ref().map_or(f64::INFINITY, |found| cost(found, unknowns, point, scale)))
            .collect();
        let Some(best) = (0..tries.len()).min_by(|one, other| costs[*one].total_cmp(&costs[*other])) else { break };
        if costs[best] >= now {
            break;
        }
        point.clone_from(&tries[best]);
        if !each(costs[best]) || now - costs[best] < 1e-3 {
            break;
        }
    }
    point
}

/// A step within the bounds; none where the equations cannot be solved.
fn step(here: &Linear, unknowns: &[Unknown], point: &[f64], scale: f64, damping: f64) -> Option<Vec<f64>> {
    let mut information = information(here, scale);
    let prior = DVector::from_iterator(unknowns.len(), distances(unknowns, point));
    let gradient = here.slopes.transpose() * &here.residuals / scale + prior;
    for index in 0..unknowns.len() {
        information[(index, index)] *= 1.0 + damping;
    }
    let change = information.cholesky()?.solve(&gradient);
    Some(
        unknowns
            .iter()
            .enumerate()
            .map(|(index, unknown)| {
                let [low, high] = unknown.coordinate_bounds();
                (point[index] - change[index] * unknown.prior[1]).clamp(low, high)
            })
            .collect(),
    )
}

/// Fisher information of the residuals and of the prior, in prior deviations.
pub fn information(here: &Linear, scale: f64) -> DMatrix<f64> {
    let count = here.slopes.ncols();
    here.slopes.transpose() * &here.slopes / scale + DMatrix::identity(count, count)
}

/// Covariance of the estimate, in prior deviations. Residuals in a block may depend on each other; blocks do not.
///
/// The sandwich `A⁻¹ B A⁻¹` with `B = Σ g gᵀ` over blocks, which holds when residuals are not white and the model is not
/// quite right (White 1982); never less than `A⁻¹`.
pub fn covariance(here: &Linear, blocks: &[usize], scale: f64) -> Option<DMatrix<f64>> {
    let count = here.slopes.ncols();
    let inverse = information(here, scale).cholesky()?.inverse();
    let mut gradients = std::collections::BTreeMap::<usize, DVector<f64>>::new();
    for (row, block) in blocks.iter().enumerate() {
        let gradient = gradients.entry(*block).or_insert_with(|| DVector::zeros(count));
        *gradient += here.slopes.row(row).transpose() * (here.residuals[row] / scale);
    }
    let blocks = gradients.len() as f64;
    let outer = gradients.values().map(|gradient| gradient * gradient.transpose()).sum::<DMatrix<f64>>()
        * (blocks / (blocks - 1.0).max(1.0))
        + DMatrix::identity(count, count);
    let sandwich = &inverse * outer * &inverse;
    // The wider of the two, unknown by unknown; correlations are the sandwich's.
    let mut covariance = sandwich.clone();
    for i in 0..count {
        for j in 0..count {
            let grown = |k: usize| (inverse[(k, k)] / sandwich[(k, k)]).max(1.0).sqrt();
            covariance[(i, j)] *= grown(i) * grown(j);
        }
    }
    Some(covariance)
}
