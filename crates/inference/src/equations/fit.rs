//! Fit of a set of causes: their columns are computed again at each estimate of their values.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::block::{Block, SHAPES, Whitener};
use super::causes::Cause;
use super::gaussian::{Group, Posterior, posterior};
use super::normal;
use super::problem::Search;
use super::residuals::{Change, Residuals, Small};
use super::robot::Robot;
use super::site::{apply, is_physical, least};

/// Change of an unknown, in its unit, below which a fit has converged.
const CONVERGED: f64 = 0.02;
/// Shares of a step that are tried where residuals are not linear in the unknowns: the second two if none of the first is better.
const STEPS: [[f64; 2]; 2] = [[1.0, 0.4], [0.15, 0.04]];
/// Iterations up to which a fit keeps the columns of the small unknowns.
const TRIAL: usize = 2;
/// Sizes of an added cause that are tried, relative to that of its screening.
const SIZES: [f64; 2] = [0.3, 0.03];
/// Decrease of the cost below which a step is not made.
const LEAST_DECREASE: f64 = 1.0;

/// A set of causes, fitted.
pub struct Fitted<R: Residuals> {
    pub causes: Vec<Cause>,
    /// True if all parameters are within their bounds.
    pub is_possible: bool,
    pub evidence: f64,
    pub posterior: Posterior,
    pub robot: Robot,
    pub predicted: R::Predicted,
    /// Residuals of the robot with no small unknowns.
    pub blocks: Vec<Block>,
    pub groups: Vec<Group>,
    /// The small unknowns.
    pub small: Arc<Small>,
    /// Their values in the robot; zeros if the residuals are linear in them.
    pub at: Vec<f64>,
}

impl<R: Residuals> Fitted<R> {
    /// Returns the logarithm of the prior probability of the causes.
    pub fn log_prior(&self) -> f64 {
        self.causes.iter().map(|cause| cause.log_prior).sum()
    }
}

impl<R: Residuals> Search<'_, R> {
    /// Fits the values of causes: their columns are computed again at each estimate.
    pub fn fit(
        &self,
        mut causes: Vec<Cause>,
        small: &Arc<Small>,
        iterations: usize,
        earlier: Option<&Fitted<R>>,
    ) -> Fitted<R> {
        let mut small = small.clone();
        let mut at = earlier.map_or_else(|| vec![0.0; small.len()], |fit| fit.at.clone());
        let mut noise = earlier.map(|fit| fit.posterior.noise.clone());
        let (mut robot, is_nonlinear) = self.robot(&causes, &mut at);
        let mut predicted = None;
        if let Some(earlier) = earlier.filter(|_| is_nonlinear) {
            let is_added = earlier.causes.len() + 1 == causes.len();
            let start = self.best_start(&causes, &at, is_added, &earlier.posterior.noise);
            (causes, at, robot, predicted) = (start.causes, start.small, start.robot, Some(start.predicted));
        }
        let mut predicted = predicted.unwrap_or_else(|| self.system.predicted(std::slice::from_ref(&robot)).remove(0));
        let mut iteration = 0;
        loop {
            let mut blocks = self.system.residuals(&robot, &predicted);
            if is_nonlinear {
                add_small(&mut blocks, &small, &at);
            }
            let groups = self.groups(&causes, &at, &robot, &predicted);
            if let (Some(noise), Some(last), false) = (&mut noise, groups.last(), is_nonlinear) {
                // The noise of before has what the last cause explains.
                let parts = last.columns.iter().flat_map(|column| &column.parts);
                parts.for_each(|(block, _)| noise[*block] = (0, 1.0));
            }
            let posterior = posterior(&blocks, [&small.groups, &groups], noise.as_deref(), &small.cache);
            let (mut moved, log_allowed, largest) = self.moved(&causes, &small, &posterior, 1.0);
            let mut next = None;
            if is_nonlinear {
                next = self.best_step((&causes, &at), (&robot, &predicted), &small, &posterior, &groups);
                moved = next.as_ref().map_or_else(|| causes.clone(), |next| next.causes.clone());
                noise = Some(posterior.noise.clone());
            }
            iteration += 1;
            let has_converged = if is_nonlinear { next.is_none() } else { largest < CONVERGED };
            if iteration >= iterations.max(1) || has_converged {
                let is_allowed = |cause: &Cause| {
                    let law = &self.laws[cause.law];
                    let mut sites = cause.scope.sites.iter().zip(&cause.values);
                    law.allows(&cause.mean(), cause.shape)
                        && sites.all(|(site, values)| is_physical(&self.base, law, *site, values))
                };
                let is_possible = moved.iter().all(is_allowed);
                let log_prior: f64 = causes.iter().map(|cause| cause.log_prior).sum();
                let evidence = posterior.evidence + log_prior + log_allowed;
                let at = next.map_or(at, |next| next.small);
                return Fitted {
                    causes: moved,
                    is_possible,
                    evidence,
                    posterior,
                    robot,
                    predicted,
                    blocks,
                    groups,
                    small,
                    at,
                };
            }
            if let Some(next) = next {
                (causes, at, robot, predicted) = (next.causes, next.small, next.robot, next.predicted);
                if iterations > TRIAL {
                    small = Arc::new(self.system.small(self.laws, &robot, &predicted));
                }
            } else {
                causes = moved;
                robot = self.robot(&causes, &mut at).0;
                predicted = self.system.predicted(std::slice::from_ref(&robot)).remove(0);
            }
        }
    }

    /// Returns the robot with causes and small unknowns, and true if residuals are not linear in these.
    fn robot(&self, causes: &[Cause], small: &mut [f64]) -> (Robot, bool) {
        let mut robot = self.base.clone();
        for cause in causes {
            self.apply(&mut robot, cause);
        }
        let is_nonlinear = self.system.apply_small(self.laws, &mut robot, small);
        (robot, is_nonlinear)
    }

    /// Returns the causes after a share of the step to their posterior means, the logarithm of the probability that their signs are
    /// allowed, and the largest step in units of the unknowns.
    fn moved(&self, causes: &[Cause], small: &Small, posterior: &Posterior, share: f64) -> (Vec<Cause>, f64, f64) {
        let mut place = small.len();
        let (mut largest, mut log_allowed) = (0.0_f64, 0.0);
        let mut moved = causes.to_vec();
        for cause in &mut moved {
            let law = &self.laws[cause.law];
            let least: Vec<f64> = cause.scope.sites.iter().map(|site| least(law, &self.base, *site)).collect();
            if law.form.is_positive {
                log_allowed += log_allowed_of(cause, &least, law.form.units[0], place, posterior);
            }
            for (values, least) in cause.values.iter_mut().zip(least) {
                for (unknown, value) in values.iter_mut().enumerate() {
                    let shift = posterior.mean[place];
                    place += 1;
                    largest = largest.max(shift.abs() / law.form.units[unknown]);
                    *value += share * shift;
                    if unknown == 0 {
                        *value = law.possible(*value, least);
                    }
                }
            }
        }
        (moved, log_allowed, largest)
    }

    /// Returns the start which leaves the smallest residuals: with other sizes of a cause that was added, or without small unknowns.
    fn best_start(&self, causes: &[Cause], small: &[f64], is_added: bool, noise: &[(usize, f64)]) -> Step<R> {
        let point = |(size, share): (f64, f64)| {
            let mut causes = causes.to_vec();
            let values = causes.last_mut().into_iter().flat_map(|last| last.values.iter_mut().flatten());
            values.for_each(|value| *value *= size);
            let mut small: Vec<f64> = small.iter().map(|value| share * value).collect();
            let robot = self.robot(&causes, &mut small).0;
            (causes, small, robot)
        };
        let starts = [(1.0, 1.0), (1.0, 0.0)].into_iter().chain(SIZES.map(|size| (size, 1.0)));
        let points: Vec<_> = starts.take(if is_added { 4 } else { 2 }).map(point).collect();
        let robots: Vec<Robot> = points.iter().map(|(_, _, robot)| robot.clone()).collect();
        let cost = |step: &Step<R>| weighted_square(&self.system.residuals(&step.robot, &step.predicted), noise);
        let steps =
            points.into_iter().zip(self.system.predicted(&robots)).map(|((causes, small, robot), predicted)| {
                let step = Step { causes, small, robot, predicted };
                (cost(&step), step)
            });
        steps.min_by(|one, other| one.0.total_cmp(&other.0)).expect("some sizes").1
    }

    /// Returns the point on the way to the posterior means at which residuals and priors are smallest; `None` if it is where the robot is.
    fn best_step(
        &self,
        (causes, at): (&[Cause], &[f64]),
        now: (&Robot, &R::Predicted),
        small: &Small,
        posterior: &Posterior,
        groups: &[Group],
    ) -> Option<Step<R>> {
        let cost = |(moved, values): (&[Cause], &[f64]), (robot, predicted): (&Robot, &R::Predicted)| {
            let mut cost = quadratic(&small.groups, values);
            for ((group, before), now) in groups.iter().zip(causes).zip(moved) {
                // Means of the groups are relative to the robot.
                let pairs = now.values.iter().flatten().zip(before.values.iter().flatten());
                cost += quadratic(
                    std::slice::from_ref(group),
                    &pairs.map(|(now, before)| now - before).collect::<Vec<_>>(),
                );
            }
            cost + weighted_square(&self.system.residuals(robot, predicted), &posterior.noise)
        };
        let mut best = (cost((causes, at), now), None);
        for shares in STEPS {
            let points = shares.map(|share| {
                let moved = self.moved(causes, small, posterior, share).0;
                let mut values: Vec<f64> =
                    at.iter().zip(posterior.mean.iter()).map(|(at, mean)| at + share * (mean - at)).collect();
                let robot = self.robot(&moved, &mut values).0;
                (moved, values, robot)
            });
            let robots: Vec<Robot> = points.iter().map(|(_, _, robot)| robot.clone()).collect();
            for ((causes, small, robot), predicted) in points.into_iter().zip(self.system.predicted(&robots)) {
                let cost = cost((&causes, &small), (&robot, &predicted));
                if cost < best.0 - LEAST_DECREASE {
                    best = (cost, Some(Step { causes, small, robot, predicted }));
                }
            }
            if best.1.is_some() {
                break;
            }
        }
        best.1
    }

    fn apply(&self, robot: &mut Robot, cause: &Cause) {
        for (site, values) in cause.scope.sites.iter().zip(&cause.values) {
            apply(robot, &self.laws[cause.law], *site, values, cause.shape);
        }
    }

    /// Returns the unknowns of each cause: how its values differ from those of the robot.
    fn groups(&self, causes: &[Cause], small: &[f64], robot: &Robot, predicted: &R::Predicted) -> Vec<Group> {
        let step = |cause: usize, unknown: usize| 0.04 * self.laws[causes[cause].law].form.units[unknown];
        let mut places = Vec::new();
        for (cause, one) in causes.iter().enumerate() {
            let unknowns = one.values[0].len();
            places.extend(
                (0..one.values.len()).flat_map(|site| (0..unknowns).map(move |unknown| (cause, site, unknown))),
            );
        }
        let change = |(cause, site, unknown): &(usize, usize, usize)| {
            // Relative to the robot with all causes, so that they compose.
            let mut changed = causes.to_vec();
            changed[*cause].values[*site][*unknown] += step(*cause, *unknown);
            let after = self.robot(&changed, &mut small.to_vec()).0;
            Change { law: &self.laws[causes[*cause].law], site: causes[*cause].scope.sites[*site], after }
        };
        let changes: Vec<Change> = places.iter().map(change).collect();
        let columns = self.system.columns((robot, predicted), &changes);
        let scaled = columns
            .iter()
            .zip(&places)
            .map(|(column, (cause, _, unknown))| column.scaled(1.0 / step(*cause, *unknown)));
        let mut columns = scaled.collect::<Vec<_>>().into_iter();
        let group = |cause: &Cause| {
            let units = &self.laws[cause.law].form.units;
            let (sites, size) = (cause.values.len(), units.len());
            let columns = columns.by_ref().take(sites * size).collect();
            let mean = DVector::from_iterator(sites * size, cause.values.iter().flatten().map(|value| -value));
            let covariance = DMatrix::from_fn(sites * size, sites * size, |row, column| {
                let (unknown, other) = (row % size, column % size);
                let is_same_site = row / size == column / size;
                if unknown == other { units[unknown].powi(2) * cause.scope.covariance(is_same_site) } else { 0.0 }
            });
            Group { columns, mean, covariance, gain: None }
        };
        causes.iter().map(group).collect()
    }
}

/// A point of a fit, with its robot.
struct Step<R: Residuals> {
    causes: Vec<Cause>,
    small: Vec<f64>,
    robot: Robot,
    predicted: R::Predicted,
}

/// Returns the sum of the squares of white residuals, relative to their variance.
fn weighted_square(blocks: &[Block], noise: &[(usize, f64)]) -> f64 {
    let of_block = |(block, (shape, variance)): (&Block, &(usize, f64))| {
        let white = Whitener::new(block, SHAPES[*shape]).whiten(&block.y);
        white.iter().map(|value| value * value).sum::<f64>() / variance
    };
    blocks.iter().zip(noise).map(of_block).sum()
}

/// Adds what small unknowns took from residuals.
fn add_small(blocks: &mut [Block], small: &Small, values: &[f64]) {
    let columns = small.groups.iter().flat_map(|group| &group.columns);
    for (column, value) in columns.zip(values) {
        for (block, rows) in &column.parts {
            blocks[*block].y.iter_mut().zip(rows).for_each(|(y, row)| *y += value * row);
        }
    }
}

/// Returns minus twice the logarithm of the prior density of values of groups, up to a constant.
fn quadratic(groups: &[Group], values: &[f64]) -> f64 {
    let mut first = 0;
    let mut sum = 0.0;
    for group in groups {
        let size = group.columns.len();
        let left = DVector::from_column_slice(&values[first..first + size]) - &group.mean;
        first += size;
        let solved = group.covariance.clone().cholesky().map(|factor| factor.solve(&left));
        sum += solved.map_or(0.0, |solved| left.dot(&solved));
    }
    sum
}

/// Returns by how much the evidence changes because the first unknowns of a cause have least values: their mean where they are alike, else
/// each.
fn log_allowed_of(cause: &Cause, least: &[f64], unit: f64, first: usize, posterior: &Posterior) -> f64 {
    let (sites, size) = (cause.values.len(), cause.values[0].len());
    let index = |site: usize| first + site * size;
    let mean = |site: usize| cause.values[site][0] + posterior.mean[index(site)];
    let variance = |one: usize, other: usize| posterior.covariance[(index(one), index(other))];
    if !cause.scope.is_alike {
        let above = |site: usize| normal::log_above(least[site], mean(site), variance(site, site).sqrt(), unit);
        return (0..sites).map(above).sum();
    }
    let count = sites as f64;
    let pairs = (0..sites).flat_map(|one| (0..sites).map(move |other| (one, other)));
    let std = pairs.map(|(one, other)| variance(one, other)).sum::<f64>().sqrt() / count;
    normal::log_above(least.iter().sum::<f64>() / count, (0..sites).map(mean).sum::<f64>() / count, std, unit)
}
