//! Local search after the refinement, for logs of a robot that walks: CMA-ES within the uncertainty of the estimate.
//!
//! Contacts that begin one step earlier or later make the cost of such logs rough. There a step of Levenberg–Marquardt may
//! find no lower cost at a point that is far from the minimum, above all at the estimate from a part of the logs.

use nalgebra::{DMatrix, DVector};
use twinstep_model::{Rollout, stream};

use crate::cmaes::CmaEs;
use crate::least_squares::LeastSquaresProblem;

/// Maximum number of generations.
const GENERATIONS: u64 = 40;
/// Standard deviation of the first generation, and below which the search has converged [std of the estimate].
const SIGMA: [f64; 2] = [1.0, 0.1];

/// Returns the point with the least cost near `point`, whose covariance is given [prior std²].
///
/// `each` receives the cost after every generation and returns false to interrupt.
pub fn local_search(
    task: &LeastSquaresProblem,
    simulator: &mut dyn Rollout,
    point: &[f64],
    covariance: &DMatrix<f64>,
    seed: u64,
    mut each: impl FnMut(f64) -> bool,
) -> Vec<f64> {
    let Some(root) = covariance.clone().cholesky().map(|factor| factor.l()) else { return point.to_vec() };
    let centre = DVector::from_iterator(point.len(), task.to_prior_units(point));
    let within_bounds = |sample: &Vec<f64>| {
        let moved = &centre + &root * DVector::from_column_slice(sample);
        task.from_prior_units(moved.as_slice())
    };
    let mut distribution = CmaEs::new(&vec![0.0; point.len()], SIGMA[0]);
    let mut best = (f64::INFINITY, point.to_vec());
    for generation in 0..GENERATIONS {
        let mut samples = distribution.ask(&mut stream(seed, "local search", generation));
        samples.push(distribution.mean().to_vec());
        let points: Vec<Vec<f64>> = samples.iter().map(within_bounds).collect();
        let costs: Vec<f64> = task
            .residuals(simulator, &points)
            .iter()
            .zip(&points)
            .map(|(found, point)| found.as_ref().map_or(f64::MAX, |found| task.cost(found, point)))
            .collect();
        for (point, cost) in points.iter().zip(&costs) {
            if *cost < best.0 {
                best = (*cost, point.clone());
            }
        }
        distribution.tell(&samples[..costs.len() - 1], &costs[..costs.len() - 1]);
        if !each(best.0) || distribution.max_std() < SIGMA[1] {
            break;
        }
    }
    best.1
}
