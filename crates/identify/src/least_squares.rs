//! Least-squares problem: free parameters of a model, and experiments whose residuals are minimised.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use twinstep_effects::ModelFile;
use twinstep_model::{Precision, Rollout};

use crate::experiment::Experiment;
use crate::nuisance::NuisanceModel;
use crate::parameter::{FreeParameter, candidate};

/// Differences that approximate derivatives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Differences {
    /// A step to either side: one point and two for each parameter.
    Central,
    /// A step to one side: one point and one for each parameter. The error is of first order in the step.
    OneSided,
}

impl Differences {
    /// Returns the values that are simulated beside `value`: the lower and the upper end, or one of them.
    ///
    /// A one-sided step that would leave the bounds is to the other side; a central difference becomes narrower.
    fn ends(self, value: f64, step: f64, [low, high]: [f64; 2]) -> Vec<f64> {
        match self {
            Self::Central => vec![(value - step).clamp(low, high), (value + step).clamp(low, high)],
            Self::OneSided if value + step <= high => vec![value + step],
            Self::OneSided => vec![value - step],
        }
    }
}

/// Appends `part` to `whole`, without a copy if that is empty.
pub fn append(whole: &mut Vec<f64>, part: Vec<f64>) {
    if whole.is_empty() { *whole = part } else { whole.extend(part) }
}

/// Least-squares problem. A point consists of the coordinates of the free parameters.
#[derive(Clone, Copy)]
pub struct LeastSquaresProblem<'a> {
    /// The model, with entries for all free parameters.
    pub file: &'a ModelFile,
    /// The free parameters.
    pub unknowns: &'a [FreeParameter],
    /// The experiments.
    pub experiments: &'a [Experiment],
    /// Scale of each residual in addition to its noise; empty for 1. See
    /// [`LeastSquaresProblem::estimate_residual_scale`].
    pub residual_scale: &'a [f64],
    /// Nuisance parameters, for residuals that are divided by `residual_scale`.
    pub tolerances: Option<&'a NuisanceModel>,
    /// Precision of the simulations.
    pub precision: Precision,
}

/// Residuals at a point, and their derivatives with respect to the coordinates [1/prior std].
pub struct Linearisation {
    /// Residuals.
    pub residuals: DVector<f64>,
    /// Jacobian: one row per residual, one column per free parameter.
    pub jacobian: DMatrix<f64>,
}

impl LeastSquaresProblem<'_> {
    /// Returns the residuals of each point, followed by the penalties of the nuisance parameters.
    ///
    /// The entry of a point is `None` if it is not a valid robot or its simulation diverges.
    pub fn residuals(&self, simulator: &mut dyn Rollout, points: &[Vec<f64>]) -> Vec<Option<Vec<f64>>> {
        let robots: Vec<_> = points.iter().map(|point| candidate(self.file, self.unknowns, point)).collect();
        let built: Vec<_> = robots.iter().flatten().cloned().collect();
        let mut found = vec![Vec::new(); built.len()];
        for experiment in self.experiments {
            let parts = experiment.residuals(simulator, &built, self.precision);
            found.iter_mut().zip(parts).for_each(|(whole, part)| append(whole, part));
        }
        let complete = |mut whole: Vec<f64>| {
            whole.iter_mut().zip(self.residual_scale).for_each(|(residual, spread)| *residual /= spread);
            let is_finite = whole.iter().all(|residual| residual.is_finite());
            if let Some(tolerances) = self.tolerances.filter(|_| is_finite) {
                tolerances.project_out(&mut whole);
            }
            is_finite.then_some(whole)
        };
        let mut found = found.into_par_iter().map(complete).collect::<Vec<_>>().into_iter();
        robots.iter().map(|robot| robot.as_ref().and_then(|_| found.next().flatten())).collect()
    }

    /// Computes residuals and Jacobian at `point`, by central differences in one batch.
    ///
    /// Returns `None` if a simulation diverges.
    pub fn linearise(&self, simulator: &mut dyn Rollout, point: &[f64]) -> Option<Linearisation> {
        self.linearise_by(Differences::Central, simulator, point)
    }

    /// Computes residuals and Jacobian at `point` in one batch.
    ///
    /// Returns `None` if a simulation diverges.
    pub fn linearise_by(
        &self,
        differences: Differences,
        simulator: &mut dyn Rollout,
        point: &[f64],
    ) -> Option<Linearisation> {
        let ends = |(unknown, value): (&FreeParameter, &f64)| {
            let step = unknown.effect.search.derivative_step * unknown.prior[1];
            differences.ends(*value, step, unknown.coordinate_bounds())
        };
        let ends: Vec<Vec<f64>> = self.unknowns.iter().zip(point).map(ends).collect();
        let moved = ends.iter().enumerate().flat_map(|(index, ends)| {
            ends.iter()
                .map(move |end| point.iter().enumerate().map(|(i, x)| if i == index { *end } else { *x }).collect())
        });
        let points: Vec<Vec<f64>> = std::iter::once(point.to_vec()).chain(moved).collect();
        let mut all = self.residuals(simulator, &points).into_iter();
        let here = DVector::from_vec(all.next()??);
        let mut jacobian = DMatrix::zeros(here.len(), self.unknowns.len());
        for (index, (ends, unknown)) in ends.iter().zip(self.unknowns).enumerate() {
            let first = DVector::from_vec(all.next()??);
            let (difference, width) = match ends[..] {
                [end] => (first - &here, end - point[index]),
                [below, above, ..] => (DVector::from_vec(all.next()??) - first, above - below),
                [] => unreachable!("every difference has an end"),
            };
            jacobian.set_column(index, &(difference * (unknown.prior[1] / width)));
        }
        Some(Linearisation { residuals: here, jacobian })
    }

    /// Returns the scale of each residual at `point`: the root mean square of its group, at least 1.
    ///
    /// Groups are quantities with a fixed or a floating base. Groups with larger model errors get smaller weights.
    pub fn estimate_residual_scale(&self, simulator: &mut dyn Rollout, point: &[f64]) -> Vec<f64> {
        let unscaled = LeastSquaresProblem { residual_scale: &[], ..*self };
        let groups: Vec<usize> = self.experiments.iter().flat_map(Experiment::groups).collect();
        let Some(residuals) = unscaled.residuals(simulator, &[point.to_vec()]).remove(0) else {
            return vec![1.0; groups.len()];
        };
        let mut sums = vec![(0.0, 0.0); Experiment::GROUPS];
        for (residual, group) in residuals.iter().zip(&groups) {
            sums[*group].0 += residual * residual;
            sums[*group].1 += 1.0;
        }
        groups.iter().map(|group| (sums[*group].0 / sums[*group].1).sqrt().max(1.0)).collect()
    }

    /// Returns the cost: sum of squares of the residuals and of the distances from the prior means.
    pub fn cost(&self, residuals: &[f64], point: &[f64]) -> f64 {
        residuals.iter().map(|residual| residual * residual).sum::<f64>()
            + self.to_prior_units(point).map(|distance| distance * distance).sum::<f64>()
    }

    /// Returns the difference of each coordinate from its prior mean [prior std].
    pub fn to_prior_units(&self, point: &[f64]) -> impl Iterator<Item = f64> {
        self.unknowns.iter().zip(point).map(|(unknown, value)| (value - unknown.prior[0]) / unknown.prior[1])
    }

    /// Inverts [`LeastSquaresProblem::to_prior_units`], and clips the coordinates to their bounds.
    pub fn from_prior_units(&self, scaled: &[f64]) -> Vec<f64> {
        let pairs = self.unknowns.iter().zip(scaled);
        let back = pairs.map(|(unknown, value)| {
            let [low, high] = unknown.coordinate_bounds();
            (unknown.prior[0] + value * unknown.prior[1]).clamp(low, high)
        });
        back.collect()
    }
}
