//! Effects that are too small to be reported.
//!
//! A log that shows one cause does not exclude a small second one: a lag comes with some delay, a friction law with another
//! one near standstill. Causes below their minimum size are not reported, but they shift the sizes of the others.

use twinstep_effects::{Composition, Effect, EffectEntry, ModelFile, Scope};
use twinstep_identify::least_squares::LeastSquaresProblem;
use twinstep_identify::parameter::{FreeParameter, free_parameters, initial_coordinate};
use twinstep_model::Rollout;

use super::confounders::alike;
use super::cross_validation::FitProblem;
use super::residual_data::ResidualData;

/// Standard deviation of an effect that is not reported, relative to its minimum size.
const SHARE_OF_MIN_SIZE: f64 = 0.25;

/// Returns the changes of the residuals of `task` by an unreported effect of one standard deviation beside the causes of
/// `fit` at its initial point: each of their confounders, on their scope.
pub fn residual_changes(
    fit: &FitProblem,
    task: &LeastSquaresProblem,
    evidence: &ResidualData,
    simulator: &mut dyn Rollout,
) -> Vec<Vec<f64>> {
    let model = fit.model(&fit.initial_point);
    let Ok((file, unknowns)) = free_parameters(&model, &beside(fit, &model, evidence)) else { return Vec::new() };
    let none: Vec<f64> = unknowns.iter().map(|unknown| initial_coordinate(&file, unknown)).collect();
    let sizes = unknowns.iter().enumerate().filter(|(_, unknown)| is_size(unknown));
    let with_one = |(index, unknown): (usize, &FreeParameter)| {
        let mut point = none.clone();
        point[index] += size(unknown);
        point
    };
    let points: Vec<Vec<f64>> = std::iter::once(none.clone()).chain(sizes.map(with_one)).collect();
    let task = LeastSquaresProblem { file: &file, unknowns: &unknowns, ..*task };
    let mut found = task.residuals(simulator, &points).into_iter();
    let Some(without) = found.next().flatten() else { return Vec::new() };
    let change = |with: Vec<f64>| with.iter().zip(&without).map(|(with, without)| with - without).collect();
    found.flatten().map(change).collect()
}

/// Returns the confounders of the causes of `fit`, each on the scope of its cause, without effects that `model` has there.
///
/// Skips effects that would replace those of the model.
fn beside(fit: &FitProblem, model: &ModelFile, evidence: &ResidualData) -> Vec<(&'static Effect, Scope)> {
    let mut beside = Vec::new();
    for FreeParameter { effect, scope, .. } in &fit.unknowns {
        for other in alike(evidence, effect).filter(|other| !other.replaces_body()) {
            let conflicts = |own: &EffectEntry| {
                own.effect == other && (own.scope == *scope || other.composition == Composition::Replace)
            };
            if !model.effects.iter().any(conflicts) && !beside.contains(&(other, *scope)) {
                beside.push((other, *scope));
            }
        }
    }
    beside
}

/// Returns true if the parameter is the size of its effect, or a component of it.
fn is_size(unknown: &FreeParameter) -> bool {
    let name = unknown.parameter_name.split('.').next();
    name == Some(unknown.effect.parameters[0].name)
}

/// Returns the size of one standard deviation [coordinate].
fn size(unknown: &FreeParameter) -> f64 {
    let [low, high] = unknown.effect.parameters[0].prior_range.map(|value| unknown.coordinate(value));
    let none = unknown.coordinate(unknown.neutral);
    let end = if unknown.neutral.is_infinite() { low } else { high };
    SHARE_OF_MIN_SIZE * unknown.effect.search.min_share * (end - none)
}
