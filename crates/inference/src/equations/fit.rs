//! Fit of a set of causes: their columns are computed again at each estimate of their values.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::block::{Block, Column};
use super::causes::Cause;
use super::gaussian::{Group, Posterior, posterior};
use super::problem::Search;
use super::robot::Robot;
use super::system::{Predicted, apply};

/// A set of causes, fitted.
pub struct Fitted {
    pub causes: Vec<Cause>,
    /// True if all parameters are within their bounds.
    pub is_possible: bool,
    pub evidence: f64,
    pub posterior: Posterior,
    pub robot: Robot,
    pub predicted: Predicted,
    pub blocks: Vec<Block>,
    pub groups: Vec<Group>,
}

impl Search<'_> {
    /// Fits the values of causes: their columns are computed again at each estimate.
    pub fn fit(&self, mut causes: Vec<Cause>, small: &[Group], iterations: usize, earlier: Option<&Fitted>) -> Fitted {
        let mut iteration = 0;
        loop {
            let mut robot = self.base.clone();
            for cause in &causes {
                self.apply(&mut robot, cause);
            }
            let predicted = self.system.predicted(&robot);
            let blocks = self.system.residuals(&robot, &predicted);
            let groups: Vec<Group> = causes
                .iter()
                .enumerate()
                .map(|(index, cause)| self.group(&causes, index, cause, &robot, &predicted))
                .collect();
            let mut noise = earlier.map(|fit| fit.posterior.noise.clone());
            if let (Some(noise), Some(last)) = (&mut noise, groups.last()) {
                // The noise of before has what the last cause explains.
                let parts = last.columns.iter().flat_map(|column| &column.parts);
                parts.for_each(|(block, _)| noise[*block] = (0, 1.0));
            }
            let posterior = posterior(&blocks, [small, &groups], noise.as_deref(), &self.cache);
            let mut first: usize = small.iter().map(|group| group.columns.len()).sum();
            let mut largest: f64 = 0.0;
            let mut moved = causes.clone();
            let mut log_allowed = 0.0;
            for cause in &mut moved {
                let law = &self.laws[cause.law];
                if law.is_positive {
                    log_allowed += log_allowed_of(cause, first, &posterior);
                }
                for values in &mut cause.values {
                    for (unknown, value) in values.iter_mut().enumerate() {
                        let shift = posterior.mean[first];
                        first += 1;
                        largest = largest.max(shift.abs() / law.units[unknown]);
                        *value += shift;
                        if law.is_positive && unknown == 0 {
                            *value = value.max(if law.strengths.is_empty() { 0.0 } else { 1e-3 });
                        }
                    }
                }
            }
            iteration += 1;
            let log_prior: f64 = causes.iter().map(|cause| cause.log_prior).sum();
            if iteration >= iterations.max(1) || largest < 0.02 {
                let is_allowed = |cause: &Cause| self.laws[cause.law].allows(&cause.mean(), cause.shape);
                let is_possible = moved.iter().all(is_allowed);
                let evidence = posterior.evidence + log_prior + log_allowed;
                return Fitted { causes: moved, is_possible, evidence, posterior, robot, predicted, blocks, groups };
            }
            causes = moved;
        }
    }

    fn apply(&self, robot: &mut Robot, cause: &Cause) {
        for (site, values) in cause.scope.sites.iter().zip(&cause.values) {
            apply(robot, &self.laws[cause.law], *site, values, cause.shape);
        }
    }

    /// Returns the unknowns of a cause: how its values differ from those of the robot.
    fn group(&self, causes: &[Cause], index: usize, cause: &Cause, robot: &Robot, predicted: &Predicted) -> Group {
        let law = &self.laws[cause.law];
        let (sites, size) = (cause.scope.sites.len(), law.units.len());
        let steps: Vec<(usize, usize)> =
            (0..sites).flat_map(|site| (0..size).map(move |unknown| (site, unknown))).collect();
        let columns: Vec<Column> = steps
            .par_iter()
            .map(|(site, unknown)| {
                // Relative to the robot with all causes, so that they compose.
                let mut changed = causes.to_vec();
                let step = 0.04 * law.units[*unknown];
                changed[index].values[*site][*unknown] += step;
                let mut after = self.base.clone();
                for cause in &changed {
                    self.apply(&mut after, cause);
                }
                self.system.column(law, cause.scope.sites[*site], (robot, predicted), &after).scaled(1.0 / step)
            })
            .collect();
        let mean = DVector::from_iterator(sites * size, cause.values.iter().flatten().map(|value| -value));
        let covariance = DMatrix::from_fn(sites * size, sites * size, |row, column| {
            let ((site, unknown), (other_site, other)) = (steps[row], steps[column]);
            if unknown != other {
                return 0.0;
            }
            law.units[unknown] * law.units[unknown] * cause.scope.covariance(site == other_site)
        });
        Group { columns, mean, covariance, gain: None }
    }
}

/// Returns the logarithm of the probability that the mean of a cause's first unknown is allowed.
fn log_allowed_of(cause: &Cause, first: usize, posterior: &Posterior) -> f64 {
    let (sites, size) = (cause.values.len(), cause.values[0].len());
    let index = |site: usize| first + site * size;
    let mean = (0..sites).map(|site| cause.values[site][0] + posterior.mean[index(site)]).sum::<f64>() / sites as f64;
    let pairs = (0..sites).flat_map(|one| (0..sites).map(move |other| (one, other)));
    let variance = pairs.map(|(one, other)| posterior.covariance[(index(one), index(other))]).sum::<f64>()
        / (sites * sites) as f64;
    let deviation = mean / variance.sqrt();
    // The tail of the normal distribution: a bound that is exact far out.
    if deviation > 0.0 { 0.0 } else { -0.5 * deviation * deviation - (1.0 - deviation).ln() }
}
