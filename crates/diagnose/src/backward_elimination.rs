//! Evidence of each cause beside all others, and elimination of those that the others explain.
//!
//! The evidence at the moment of acceptance is that of a model that lacks the causes found later: a shifted centre of
//! mass is accepted before the payload that it imitates.

use twinstep_effects::ModelFile;
use twinstep_model::Rollout;

use super::DiagnoseError;
use super::cross_validation::{CandidateFit, FitProblem, cross_validate};
use super::forward_selection::ForwardSelection;
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;

/// Sets evidence, gain and explained fraction of each cause to those that it has beside all others.
pub fn evidence_beside_others(search: &mut ForwardSelection) -> Result<(), DiagnoseError> {
    let evidence = &search.views[search.view].evidence;
    let hypotheses: Vec<Hypothesis> = search.accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
    for place in 0..hypotheses.len() {
        let name = hypotheses[place].name();
        (search.progress)(&format!("comparing with a model without {name}; causes: {}", hypotheses.len()))?;
        let found = without(evidence, &search.baseline, &hypotheses, place, search.simulator);
        let (best, others) = &mut search.accepted[place];
        let (score, gain, explained_fraction) =
            found.map_or((0.0, 0.0, 0.0), |found| (found.score, found.gain, found.explained_fraction));
        // Alternatives keep their distance from the cause.
        for other in others.iter_mut() {
            other.score += score - best.score;
        }
        (best.score, best.gain, best.explained_fraction) = (score, gain, explained_fraction);
    }
    Ok(())
}

/// Removes causes without evidence beside the others, the weakest first, and refits the rest.
pub fn eliminate(search: &mut ForwardSelection) -> Result<(), DiagnoseError> {
    if search.accepted.len() < 2 {
        return Ok(());
    }
    loop {
        evidence_beside_others(search)?;
        let excess = |place: &usize| search.accepted[*place].0.score - search.accepted[*place].0.threshold;
        let weakest = (0..search.accepted.len()).min_by(|one, other| excess(one).total_cmp(&excess(other)));
        let Some(weakest) = weakest.filter(|place| excess(place) < 0.0) else { return Ok(()) };
        search.accepted.remove(weakest);
        search.refit();
    }
}

/// Returns the evidence for one of the causes, given that all others are refitted without it.
fn without(
    evidence: &ResidualData,
    baseline: &ModelFile,
    hypotheses: &[Hypothesis],
    place: usize,
    simulator: &mut dyn Rollout,
) -> Option<CandidateFit> {
    let others: Vec<Hypothesis> =
        hypotheses.iter().enumerate().filter(|(index, _)| *index != place).map(|(_, one)| one.clone()).collect();
    let model = if others.is_empty() {
        baseline.clone()
    } else {
        let fit = FitProblem::new(baseline, &others)?;
        let point = fit.solve(&evidence.fit_rows, simulator);
        fit.model(&point)
    };
    let before = evidence.residual_power(simulator, &model.robot_model().ok()?);
    let found = cross_validate(evidence, &model, &before, &hypotheses[place], simulator)?;
    Some(CandidateFit { hypothesis: hypotheses[place].clone(), ..found })
}
