//! What is asked of the data: numbers of a model, and the experiments that its simulations are to follow.

use nalgebra::{DMatrix, DVector};
use twinstep_effects::ModelFile;
use twinstep_model::{Precision, Rollout};

use crate::experiment::Experiment;
use crate::nuisance::NuisanceModel;
use crate::parameter::{FreeParameter, candidate};

/// Half a difference, in prior standard deviations.
const STEP: f64 = 0.02;

/// What is asked. A point is the unknowns' coordinates.
#[derive(Clone, Copy)]
pub struct LeastSquaresProblem<'a> {
    /// The model with an entry for each unknown.
    pub file: &'a ModelFile,
    /// What is sought.
    pub unknowns: &'a [FreeParameter],
    /// What is to be followed.
    pub experiments: &'a [Experiment],
    /// What residuals are divided by, one by one, besides their noise; empty for nothing. See [`LeastSquaresProblem::spread`].
    pub residual_scale: &'a [f64],
    /// Errors that explain residuals at a price, for residuals that are divided by `spread`.
    pub tolerances: Option<&'a NuisanceModel>,
    /// What candidates are simulated in.
    pub precision: Precision,
}

/// Residuals at a point, and their derivatives by the coordinates in units of their prior deviations.
pub struct Linearisation {
    /// Residuals.
    pub residuals: DVector<f64>,
    /// One row a residual, one column an unknown.
    pub jacobian: DMatrix<f64>,
}

impl LeastSquaresProblem<'_> {
    /// Residuals at points, one after the other, then what tolerated errors cost; none of a point that is no robot or
    /// diverged.
    pub fn residuals(&self, simulator: &mut dyn Rollout, points: &[Vec<f64>]) -> Vec<Option<Vec<f64>>> {
        let robots: Vec<_> = points.iter().map(|point| candidate(self.file, self.unknowns, point)).collect();
        let built: Vec<_> = robots.iter().flatten().cloned().collect();
        let mut parts: Vec<std::vec::IntoIter<Vec<f64>>> = self
            .experiments
            .iter()
            .map(|experiment| experiment.residuals(simulator, &built, self.precision).into_iter())
            .collect();
        robots
            .iter()
            .map(|robot| {
                robot.as_ref()?;
                let mut whole: Vec<f64> = parts.iter_mut().flat_map(|part| part.next().unwrap_or_default()).collect();
                whole.iter_mut().zip(self.residual_scale).for_each(|(residual, spread)| *residual /= spread);
                if whole.iter().any(|residual| !residual.is_finite()) {
                    return None;
                }
                if let Some(tolerances) = self.tolerances {
                    tolerances.project_out(&mut whole);
                }
                Some(whole)
            })
            .collect()
    }

    /// Residuals and slopes at `point`: central differences in one batch; none where a neighbour diverges.
    pub fn linearise(&self, simulator: &mut dyn Rollout, point: &[f64]) -> Option<Linearisation> {
        let mut points = vec![point.to_vec()];
        let mut widths = Vec::new();
        for (index, unknown) in self.unknowns.iter().enumerate() {
            let [low, high] = unknown.coordinate_bounds();
            let ends = [-1.0, 1.0].map(|side| (point[index] + side * STEP * unknown.prior[1]).clamp(low, high));
            widths.push((ends[1] - ends[0]) / unknown.prior[1]);
            for end in ends {
                let mut moved = point.to_vec();
                moved[index] = end;
                points.push(moved);
            }
        }
        let mut all = self.residuals(simulator, &points).into_iter();
        let here = DVector::from_vec(all.next()??);
        let mut slopes = DMatrix::zeros(here.len(), self.unknowns.len());
        for (index, width) in widths.into_iter().enumerate() {
            let (below, above) = (all.next()??, all.next()??);
            let slope = above.iter().zip(&below).map(|(above, below)| (above - below) / width);
            slopes.set_column(index, &DVector::from_iterator(here.len(), slope));
        }
        Some(Linearisation { residuals: here, jacobian: slopes })
    }

    /// How much larger than their noise the residuals of `point` are, by quantity and by whether the base was fixed; at least
    /// 1. A model errs in some of them more than in others, and those say less.
    pub fn estimate_residual_scale(&self, simulator: &mut dyn Rollout, point: &[f64]) -> Vec<f64> {
        let unspread = LeastSquaresProblem { residual_scale: &[], ..*self };
        let groups: Vec<usize> = self.experiments.iter().flat_map(Experiment::groups).collect();
        let Some(residuals) = unspread.residuals(simulator, &[point.to_vec()]).remove(0) else {
            return vec![1.0; groups.len()];
        };
        let mut sums = vec![(0.0, 0.0); Experiment::GROUPS];
        for (residual, group) in residuals.iter().zip(&groups) {
            sums[*group].0 += residual * residual;
            sums[*group].1 += 1.0;
        }
        groups.iter().map(|group| (sums[*group].0 / sums[*group].1).sqrt().max(1.0)).collect()
    }

    /// Cost of residuals, and of the distance to the prior.
    pub fn cost(&self, residuals: &[f64], point: &[f64]) -> f64 {
        residuals.iter().map(|residual| residual * residual).sum::<f64>()
            + self.to_prior_units(point).map(|distance| distance * distance).sum::<f64>()
    }

    /// A point's distance from the prior means, in prior deviations.
    pub fn to_prior_units(&self, point: &[f64]) -> impl Iterator<Item = f64> {
        self.unknowns.iter().zip(point).map(|(unknown, value)| (value - unknown.prior[0]) / unknown.prior[1])
    }

    /// Back from [`LeastSquaresProblem::to_prior_units`], to the nearest point that is allowed.
    pub fn from_prior_units(&self, scaled: &[f64]) -> Vec<f64> {
        let pairs = self.unknowns.iter().zip(scaled);
        let back = pairs.map(|(unknown, value)| {
            let [low, high] = unknown.coordinate_bounds();
            (unknown.prior[0] + value * unknown.prior[1]).clamp(low, high)
        });
        back.collect()
    }
}
