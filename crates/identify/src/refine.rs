//! Levenberg–Marquardt refinement, and covariance of the estimate.

use nalgebra::{DMatrix, DVector};
use twinstep_model::Rollout;

use crate::least_squares::{LeastSquaresProblem, Linearisation};

/// Decrease of the cost below which the refinement has converged; one standard deviation is a cost of 1.
const COST_TOLERANCE: f64 = 0.1;
/// Maximum number of iterations.
const MAX_ITERATIONS: usize = 30;
/// Levenberg–Marquardt damping factors, all evaluated in one batch per iteration.
pub const DAMPING_FACTORS: [f64; 8] = [0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3];

/// Minimises the cost from `point`. `each` receives the cost after every step and returns false to interrupt.
///
/// Each iteration evaluates the steps with all of these `damping` factors, such as [`DAMPING_FACTORS`].
pub fn refine(
    task: &LeastSquaresProblem,
    simulator: &mut dyn Rollout,
    damping: &[f64],
    mut point: Vec<f64>,
    mut each: impl FnMut(f64) -> bool,
) -> Vec<f64> {
    for _ in 0..MAX_ITERATIONS {
        let Some(here) = task.linearise(simulator, &point) else { break };
        let now = task.cost(here.residuals.as_slice(), &point);
        let candidates: Vec<_> = damping.iter().filter_map(|damping| step(task, &here, &point, *damping)).collect();
        let costs: Vec<f64> = task
            .residuals(simulator, &candidates)
            .iter()
            .zip(&candidates)
            .map(|(found, point)| found.as_ref().map_or(f64::INFINITY, |found| task.cost(found, point)))
            .collect();
        let Some(best) = (0..candidates.len()).min_by(|one, other| costs[*one].total_cmp(&costs[*other])) else {
            break;
        };
        if costs[best] >= now {
            break;
        }
        point.clone_from(&candidates[best]);
        if !each(costs[best]) || now - costs[best] < COST_TOLERANCE {
            break;
        }
    }
    point
}

/// Returns the point after a damped step, within the bounds. Returns `None` if the equations cannot be solved.
fn step(task: &LeastSquaresProblem, here: &Linearisation, point: &[f64], damping: f64) -> Option<Vec<f64>> {
    let mut information = information(here);
    let prior = DVector::from_iterator(point.len(), task.to_prior_units(point));
    let gradient = here.jacobian.transpose() * &here.residuals + &prior;
    for index in 0..point.len() {
        information[(index, index)] *= 1.0 + damping;
    }
    let moved = prior - information.cholesky()?.solve(&gradient);
    Some(task.from_prior_units(moved.as_slice()))
}

/// Lower bound on the standard deviation of an estimate [prior std]: the mismatch between simulators.
///
/// Measured with rapier as the robot and the batch engine as the model (`parameter_recovery`): friction torques differ
/// by 0.01 N·m, masses by 1 %.
pub const SIMULATOR_MISMATCH_STD: f64 = 0.02;

/// Returns the Fisher information of residuals and prior [1/prior std²].
pub fn information(here: &Linearisation) -> DMatrix<f64> {
    let count = here.jacobian.ncols();
    here.jacobian.transpose() * &here.jacobian + DMatrix::identity(count, count)
}

/// Returns the covariance of the estimate [prior std²].
///
/// Sandwich estimator `A⁻¹ B A⁻¹` with `B = Σ g gᵀ` over blocks (White 1982). It is valid for correlated residuals
/// within blocks and for model errors; blocks must be independent. Variances are at least those of `A⁻¹` and
/// [`SIMULATOR_MISMATCH_STD`]². Each of `errors` adds its effect on the estimate: residuals of a nuisance parameter of
/// one standard deviation.
pub fn covariance(here: &Linearisation, blocks: &[usize], errors: &[Vec<f64>]) -> Option<DMatrix<f64>> {
    let count = here.jacobian.ncols();
    let inverse = information(here).cholesky()?.inverse();
    let mut gradients = std::collections::BTreeMap::<usize, DVector<f64>>::new();
    for (row, block) in blocks.iter().enumerate() {
        let gradient = gradients.entry(*block).or_insert_with(|| DVector::zeros(count));
        *gradient += here.jacobian.row(row).transpose() * here.residuals[row];
    }
    let blocks = gradients.len() as f64;
    let outer = gradients.values().map(|gradient| gradient * gradient.transpose()).sum::<DMatrix<f64>>()
        * (blocks / (blocks - count as f64).max(1.0))
        + DMatrix::identity(count, count);
    let sandwich = &inverse * outer * &inverse
        + DMatrix::identity(count, count) * (SIMULATOR_MISMATCH_STD * SIMULATOR_MISMATCH_STD);
    // The larger variance of the two for each parameter, with the correlations of the sandwich.
    let mut covariance = sandwich.clone();
    for i in 0..count {
        for j in 0..count {
            let growth = |k: usize| (inverse[(k, k)] / sandwich[(k, k)]).max(1.0).sqrt();
            covariance[(i, j)] *= growth(i) * growth(j);
        }
    }
    for error in errors {
        let moved = &inverse * here.jacobian.tr_mul(&DVector::from_column_slice(error));
        covariance += &moved * moved.transpose();
    }
    Some(covariance)
}
