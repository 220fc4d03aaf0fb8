//! CMA-ES with ask-and-tell interface (Hansen, "The CMA Evolution Strategy: A Tutorial", 2016).

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rand::Rng;
use serde::{Deserialize, Serialize};
use twinstep_model::standard_normal;

/// Search distribution over coordinates with scales of about one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CmaEs {
    mean: DVector<f64>,
    sigma: f64,
    covariance: DMatrix<f64>,
    /// Square root of the covariance.
    root: DMatrix<f64>,
    /// Inverse of `root`.
    inverse_root: DMatrix<f64>,
    path: DVector<f64>,
    sigma_path: DVector<f64>,
    weights: Vec<f64>,
    generation: usize,
}

impl CmaEs {
    /// Creates a distribution around `mean` with standard deviation `sigma` along each axis.
    pub fn new(mean: &[f64], sigma: f64) -> Self {
        let n = mean.len();
        let population = 4 + (3.0 * (n as f64).ln()).floor() as usize;
        // A larger population than the default uses all cores and SIMD lanes, and is more robust in narrow minima.
        let parents = population.max(16);
        let raw: Vec<f64> = (1..=parents).map(|rank| (parents as f64 + 0.5).ln() - (rank as f64).ln()).collect();
        let sum: f64 = raw.iter().sum();
        Self {
            mean: DVector::from_column_slice(mean),
            sigma,
            covariance: DMatrix::identity(n, n),
            root: DMatrix::identity(n, n),
            inverse_root: DMatrix::identity(n, n),
            path: DVector::zeros(n),
            sigma_path: DVector::zeros(n),
            weights: raw.into_iter().map(|weight| weight / sum).collect(),
            generation: 0,
        }
    }

    /// Returns the mean.
    pub fn mean(&self) -> &[f64] {
        self.mean.as_slice()
    }

    /// Returns the number of points of a generation.
    pub fn population(&self) -> usize {
        2 * self.weights.len()
    }

    /// Samples the points of a generation.
    pub fn ask(&self, random: &mut impl Rng) -> Vec<Vec<f64>> {
        let n = self.mean.len();
        (0..self.population())
            .map(|_| {
                let normal = DVector::from_fn(n, |_, _| standard_normal(random));
                (&self.mean + self.sigma * (&self.root * normal)).iter().copied().collect()
            })
            .collect()
    }

    /// Updates the distribution with the costs of the points.
    pub fn tell(&mut self, points: &[Vec<f64>], costs: &[f64]) {
        let n = self.mean.len() as f64;
        let mut order: Vec<usize> = (0..points.len()).collect();
        order.sort_by(|one, other| costs[*one].total_cmp(&costs[*other]));
        let effective = 1.0 / self.weights.iter().map(|weight| weight * weight).sum::<f64>();
        let c_sigma = (effective + 2.0) / (n + effective + 5.0);
        let damping = 1.0 + 2.0 * (((effective - 1.0) / (n + 1.0)).sqrt() - 1.0).max(0.0) + c_sigma;
        let c_path = (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n);
        let c_one = 2.0 / ((n + 1.3).powi(2) + effective);
        let c_mu = (1.0 - c_one).min(2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0).powi(2) + effective));
        let length = n.sqrt() * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n));

        let steps: Vec<DVector<f64>> = order[..self.weights.len()]
            .iter()
            .map(|index| (DVector::from_column_slice(&points[*index]) - &self.mean) / self.sigma)
            .collect();
        let step = steps.iter().zip(&self.weights).map(|(step, weight)| step * *weight).sum::<DVector<f64>>();
        self.mean += self.sigma * &step;
        self.sigma_path = (1.0 - c_sigma) * &self.sigma_path
            + (c_sigma * (2.0 - c_sigma) * effective).sqrt() * (&self.inverse_root * &step);
        self.generation += 1;
        let settled = 1.0 - (1.0 - c_sigma).powi(2 * self.generation as i32);
        let going = self.sigma_path.norm() / settled.sqrt() < (1.4 + 2.0 / (n + 1.0)) * length;
        let gain = if going { (c_path * (2.0 - c_path) * effective).sqrt() } else { 0.0 };
        self.path = (1.0 - c_path) * &self.path + gain * &step;
        let lost = if going { 0.0 } else { c_one * c_path * (2.0 - c_path) };
        let spread = steps
            .iter()
            .zip(&self.weights)
            .map(|(step, weight)| *weight * step * step.transpose())
            .sum::<DMatrix<f64>>();
        self.covariance =
            (1.0 - c_one - c_mu + lost) * &self.covariance + c_one * &self.path * self.path.transpose() + c_mu * spread;
        self.sigma *= ((c_sigma / damping) * (self.sigma_path.norm() / length - 1.0)).exp().min(2.0);
        self.factor();
    }

    /// Returns the largest standard deviation along a coordinate axis.
    pub fn max_std(&self) -> f64 {
        self.sigma * self.covariance.diagonal().iter().copied().fold(0.0, f64::max).sqrt()
    }

    fn factor(&mut self) {
        let symmetric = 0.5 * (&self.covariance + self.covariance.transpose());
        let eigen = SymmetricEigen::new(symmetric);
        let roots = eigen.eigenvalues.map(|value| value.max(1e-14).sqrt());
        let rebuilt = |values: DVector<f64>| {
            &eigen.eigenvectors * DMatrix::from_diagonal(&values) * eigen.eigenvectors.transpose()
        };
        self.root = rebuilt(roots.clone());
        self.inverse_root = rebuilt(roots.map(|root| 1.0 / root));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the Rosenbrock function, whose minimum is 0 at (1, …, 1).
    fn rosenbrock(x: &[f64]) -> f64 {
        x.windows(2).map(|pair| 100.0 * (pair[1] - pair[0] * pair[0]).powi(2) + (1.0 - pair[0]).powi(2)).sum()
    }

    #[test]
    fn rosenbrock_function_is_minimised() {
        let mut random = twinstep_model::stream(1, "cmaes", 0);
        let mut search = CmaEs::new(&[-1.0, 0.5, 0.0, 2.0, 1.0], 0.5);
        for _ in 0..300 {
            let points = search.ask(&mut random);
            let costs: Vec<f64> = points.iter().map(|point| rosenbrock(point)).collect();
            search.tell(&points, &costs);
        }
        let cost = rosenbrock(search.mean.as_slice());
        assert!(cost < 1e-8, "{cost} at {:?}", search.mean);
        assert!(search.max_std() < 1e-3);
    }
}
