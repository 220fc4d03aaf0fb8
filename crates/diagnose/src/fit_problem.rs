//! Fit of effects on top of a model, in full simulation.

use twinstep_effects::{Effect, ModelFile, Scope, Target};
use twinstep_identify::least_squares::LeastSquaresProblem;
use twinstep_identify::parameter::{FreeParameter, free_parameters, initial_coordinate, with_values};
use twinstep_identify::refine::{DAMPING_FACTORS, refine};
use twinstep_model::Rollout;

use super::hypothesis::Hypothesis;
use super::residual_rows::{PRECISION, ResidualRows};

/// Maximum number of refinement steps.
const STEPS: usize = 6;
/// Relative decrease of the cost below which the refinement has converged.
const SETTLED: f64 = 1e-3;

/// Fit of effects on top of a model.
#[derive(Clone)]
pub struct FitProblem {
    /// The model with an entry for each effect.
    pub file: ModelFile,
    /// Free parameters of the effects.
    pub unknowns: Vec<FreeParameter>,
    /// Initial point of the refinement [coordinates].
    pub initial_point: Vec<f64>,
}

impl FitProblem {
    /// Creates the fit of all `hypotheses`. Returns `None` if their entries conflict.
    pub fn new(model: &ModelFile, hypotheses: &[Hypothesis]) -> Option<Self> {
        let effects: Vec<(&'static Effect, Scope)> = hypotheses.iter().map(|one| (one.effect, one.scope)).collect();
        let (file, unknowns) = free_parameters(model, &effects).ok()?;
        let values: Vec<f64> = hypotheses.iter().flat_map(|one| one.values.iter().copied()).collect();
        // The initial value of an infinite value is that of the file.
        let begin = unknowns.iter().zip(&values).map(|(unknown, value)| {
            if value.is_finite() { unknown.coordinate(*value) } else { initial_coordinate(&file, unknown) }
        });
        Some(Self { initial_point: begin.collect(), file, unknowns })
    }

    /// Returns the point with the least cost on `rows` [coordinates].
    pub fn solve(&self, rows: &ResidualRows, simulator: &mut dyn Rollout) -> Vec<f64> {
        let (file, unknowns, experiments) = (&self.file, &self.unknowns[..], &rows.experiments[..]);
        let tolerances = rows.tolerances.as_ref();
        let precision = PRECISION;
        let task = LeastSquaresProblem { file, unknowns, experiments, residual_scale: &[], tolerances, precision };
        let mut scale = task.estimate_residual_scale(simulator, &self.initial_point);
        let targets: Vec<Target> = unknowns.iter().map(|unknown| unknown.effect.target).collect();
        rows.raise_scales_on_ground(&mut scale, &targets);
        let tolerances = tolerances.and_then(|tolerances| tolerances.rescaled(&scale));
        let task = LeastSquaresProblem { residual_scale: &scale, tolerances: tolerances.as_ref(), ..task };
        let (mut steps, mut last) = (0, f64::INFINITY);
        refine(&task, simulator, &DAMPING_FACTORS, self.initial_point.clone(), |cost| {
            steps += 1;
            let settled = last - cost < SETTLED * cost;
            last = cost;
            steps < STEPS && !settled
        })
    }

    /// Returns the model at a point.
    pub fn model(&self, point: &[f64]) -> ModelFile {
        with_values(&self.file, &self.unknowns, point)
    }
}
