//! Global search: CMA-ES in units of prior standard deviations, which can be interrupted and resumed.

use serde::{Deserialize, Serialize};
use twinstep_model::{Rollout, stream};

use crate::cmaes::CmaEs;
use crate::least_squares::LeastSquaresProblem;

/// Relative decrease of the lowest cost over [`PATIENCE`] generations below which the search has converged.
const MIN_IMPROVEMENT: f64 = 0.02;
/// Number of generations for [`MIN_IMPROVEMENT`].
const PATIENCE: usize = 6;
/// Standard deviation of the distribution below which the search has converged [prior std].
const MIN_SIGMA: f64 = 0.01;

/// State of a global search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GlobalSearch {
    /// Description of the problem; a search can only be resumed for the same problem.
    pub problem_key: String,
    distribution: CmaEs,
    /// Best point so far [coordinates].
    pub best: Vec<f64>,
    /// Cost of the best point.
    lowest: f64,
    /// Lowest cost after each generation.
    best_cost_history: Vec<f64>,
}

impl GlobalSearch {
    /// Creates a search that starts at `begin` [coordinates].
    pub fn new(problem_key: String, task: &LeastSquaresProblem, begin: Vec<f64>, simulator: &mut dyn Rollout) -> Self {
        let residuals = task.residuals(simulator, std::slice::from_ref(&begin)).remove(0);
        let lowest = residuals.map_or(f64::MAX, |residuals| task.cost(&residuals, &begin));
        let distribution = CmaEs::new(&task.to_prior_units(&begin).collect::<Vec<_>>(), 0.5);
        Self { problem_key, distribution, best: begin, lowest, best_cost_history: Vec::new() }
    }

    /// Runs until convergence or `generations` in total. Returns true if `progress` interrupted it.
    pub fn run(
        &mut self,
        task: &LeastSquaresProblem,
        simulator: &mut dyn Rollout,
        generations: usize,
        seed: u64,
        mut progress: impl FnMut(usize, f64) -> bool,
    ) -> bool {
        while self.best_cost_history.len() < generations && !self.converged() {
            self.generation(task, simulator, seed);
            if !progress(self.best_cost_history.len(), self.lowest) {
                return true;
            }
        }
        false
    }

    fn generation(&mut self, task: &LeastSquaresProblem, simulator: &mut dyn Rollout, seed: u64) {
        let samples = self.distribution.ask(&mut stream(seed, "identify", self.best_cost_history.len() as u64));
        // A sample outside the bounds is evaluated at the bounds; its squared distance from them is penalised.
        let points: Vec<Vec<f64>> = samples.iter().map(|point| task.from_prior_units(point)).collect();
        let residuals = task.residuals(simulator, &points);
        let costs: Vec<f64> = (0..points.len())
            .map(|index| {
                let pairs = task.to_prior_units(&points[index]).zip(&samples[index]);
                let distance: f64 = pairs.map(|(one, other)| (one - other).powi(2)).sum();
                let residuals = residuals[index].as_ref();
                residuals.map_or(f64::MAX, |residuals| task.cost(residuals, &points[index]) * (1.0 + distance))
            })
            .collect();
        for (point, cost) in points.iter().zip(&costs) {
            if *cost < self.lowest {
                self.lowest = *cost;
                self.best.clone_from(point);
            }
        }
        self.distribution.tell(&samples, &costs);
        self.best_cost_history.push(self.lowest);
    }

    /// Returns true if the search has converged. Close to a minimum, Levenberg–Marquardt is faster.
    fn converged(&self) -> bool {
        let before = self.best_cost_history.len().checked_sub(PATIENCE + 1).map(|index| self.best_cost_history[index]);
        self.distribution.max_std() < MIN_SIGMA
            || before.is_some_and(|before| before - self.lowest < MIN_IMPROVEMENT * self.lowest)
    }
}
