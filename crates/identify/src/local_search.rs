//! Local search after the refinement, for logs with a floating base: CMA-ES within the uncertainty of the estimate.
//!
//! Contacts that begin one step earlier or later make the cost of such logs rough. Then no step of Levenberg–Marquardt may have
//! a lower cost although the minimum is far: an identification that starts from an earlier model stays there.

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
    let moved = |sample: &Vec<f64>| &centre + &root * DVector::from_column_slice(sample);
    let mut distribution = CmaEs::new(&vec![0.0; point.len()], SIGMA[0]);
    let mut best = (f64::MAX, point.to_vec());
    for generation in 0..GENERATIONS {
        let mut samples = distribution.ask(&mut stream(seed, "local search", generation));
        samples.push(distribution.mean().to_vec());
        let wanted: Vec<DVector<f64>> = samples.iter().map(moved).collect();
        let points: Vec<Vec<f64>> = wanted.iter().map(|wanted| task.from_prior_units(wanted.as_slice())).collect();
        // As in the global search, a sample outside the bounds is evaluated at the bounds, and its distance is penalised.
        let residuals = task.residuals(simulator, &points);
        let cost = |index: usize| {
            let (point, wanted) = (&points[index], &wanted[index]);
            let distance: f64 = task.to_prior_units(point).zip(wanted).map(|(one, other)| (one - other).powi(2)).sum();
            residuals[index].as_ref().map_or(f64::MAX, |found| task.cost(found, point) * (1.0 + distance))
        };
        let costs: Vec<f64> = (0..points.len()).map(cost).collect();
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
