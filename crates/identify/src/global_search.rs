//! The global search: CMA-ES in prior deviations, which can be ended and taken up again.

use serde::{Deserialize, Serialize};
use twinstep_model::{Rollout, stream};

use crate::cmaes::CmaEs;
use crate::least_squares::LeastSquaresProblem;

/// Generations in which the search has to get better by this share.
const MIN_IMPROVEMENT: f64 = 0.02;
/// How many they are.
const PATIENCE: usize = 6;
/// Width of the distribution, in prior deviations, from which Gauss-Newton does the rest.
const MIN_SIGMA: f64 = 0.01;

/// A search as far as it has come.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GlobalSearch {
    /// What is sought in what, in words: only the same can be taken up again.
    pub problem_key: String,
    distribution: CmaEs,
    /// The best so far [coordinates].
    pub best: Vec<f64>,
    /// Its cost.
    lowest: f64,
    /// The lowest cost after each generation.
    best_cost_history: Vec<f64>,
}

impl GlobalSearch {
    /// From `begin` [coordinates].
    pub fn new(problem_key: String, task: &LeastSquaresProblem, begin: Vec<f64>, simulator: &mut dyn Rollout) -> Self {
        let judged = task.residuals(simulator, std::slice::from_ref(&begin)).remove(0);
        let lowest = judged.map_or(f64::MAX, |found| task.cost(&found, &begin));
        let distribution = CmaEs::new(&task.to_prior_units(&begin).collect::<Vec<_>>(), 0.5);
        Self { problem_key, distribution, best: begin, lowest, best_cost_history: Vec::new() }
    }

    /// Goes on for `generations` in all; true if `progress` ended it.
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
        let asked = self.distribution.ask(&mut stream(seed, "identify", self.best_cost_history.len() as u64));
        // A point beyond a bound is judged at the bound, and pays for the way.
        let points: Vec<Vec<f64>> = asked.iter().map(|point| task.from_prior_units(point)).collect();
        let found = task.residuals(simulator, &points);
        let costs: Vec<f64> = (0..points.len())
            .map(|index| {
                let pairs = task.to_prior_units(&points[index]).zip(&asked[index]);
                let beyond: f64 = pairs.map(|(one, other)| (one - other).powi(2)).sum();
                let found = found[index].as_ref();
                found.map_or(f64::MAX, |found| task.cost(found, &points[index]) * (1.0 + beyond))
            })
            .collect();
        for (point, cost) in points.iter().zip(&costs) {
            if *cost < self.lowest {
                self.lowest = *cost;
                self.best.clone_from(point);
            }
        }
        self.distribution.tell(&asked, &costs);
        self.best_cost_history.push(self.lowest);
    }

    /// Gauss-Newton is faster in a valley: the search has only to find it.
    fn converged(&self) -> bool {
        let before = self.best_cost_history.len().checked_sub(PATIENCE + 1).map(|index| self.best_cost_history[index]);
        self.distribution.max_std() < MIN_SIGMA || before.is_some_and(|before| before - self.lowest < MIN_IMPROVEMENT * self.lowest)
    }
}
