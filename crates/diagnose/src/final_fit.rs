//! Final fit of the causes to all rows, with intervals.
//!
//! The held-out blocks have measured the errors by then. They contain what the other rows lack, such as fast motion.

use twinstep_effects::ModelFile;
use twinstep_identify::identify::blocks;
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::refine::{SIMULATOR_MISMATCH_STD, covariance};
use twinstep_model::{Precision, Rollout};

use super::cross_validation::FitProblem;
use super::findings::CorrelatedPair;
use super::forward_selection::{Accepted, write_estimates};
use super::residual_data::ResidualData;
use super::residual_rows::ResidualRows;
use super::{joint_fit, profile_likelihood, reporting, size_drift};

/// Causes fitted to all rows.
pub struct FinalFit {
    /// The given model with the causes and their 95 % intervals.
    pub extended: ModelFile,
    /// Pairs of highly correlated causes.
    pub confusable: Vec<CorrelatedPair>,
    /// Values of the first parameter of each cause in the two halves of the rows, if it drifts.
    pub drifts: Vec<Option<[f64; 2]>>,
}

impl FinalFit {
    /// Fits `accepted` on top of `model`, whose ground is fitted in `judged`, and writes their values.
    ///
    /// Causes that the other rows have made larger than they are, so that they are now too small to report, are removed.
    pub fn new(
        model: &ModelFile,
        judged: &ModelFile,
        accepted: &mut Accepted,
        evidence: &ResidualData,
        simulator: &mut dyn Rollout,
    ) -> Self {
        let fitted = fit_to_all_rows(judged, accepted, evidence, simulator);
        let fit = joint_fit(model, accepted);
        let (Some((point, all_rows)), Some(fit)) = (fitted, fit) else {
            return Self { extended: model.clone(), confusable: Vec::new(), drifts: Vec::new() };
        };
        let fit = FitProblem { initial_point: point, ..fit };
        let experiments = &all_rows.experiments;
        let robot = fit.model(&fit.initial_point).robot_model().ok();
        let tolerances = robot.and_then(|robot| NuisanceModel::new(experiments, &robot, simulator));
        let covariance = fit.with_problem(&all_rows, simulator, Precision::Double, |task, simulator| {
            let errors = tolerances.map_or(Vec::new(), |all| all.robot_errors(task.residual_scale, task.tolerances));
            covariance(&task.linearise(simulator, &fit.initial_point)?, &blocks(experiments), &errors)
        });
        let near = profile_likelihood::profile_intervals(&fit, evidence, simulator);
        let (extended, confusable) =
            reporting::with_intervals(&fit, covariance.as_ref(), SIMULATOR_MISMATCH_STD, &near);
        let values = size_drift::drifting_values(&fit, evidence, simulator);
        let mut first = 0;
        let drifts = accepted.iter().map(|(best, _)| {
            let own = values[first];
            first += best.hypothesis.values.len();
            own
        });
        Self { extended, confusable, drifts: drifts.collect() }
    }
}

/// Fits the causes to all rows until none of them is too small. Returns the point and the rows; `None` without causes.
fn fit_to_all_rows(
    judged: &ModelFile,
    accepted: &mut Accepted,
    evidence: &ResidualData,
    simulator: &mut dyn Rollout,
) -> Option<(Vec<f64>, ResidualRows)> {
    loop {
        let fit = joint_fit(judged, accepted)?;
        let all_rows = evidence.all_rows(&fit.model(&fit.initial_point), simulator);
        let point = fit.solve(&all_rows, simulator);
        write_estimates(accepted, &fit, &point);
        let found = accepted.len();
        accepted.retain(|(best, _)| best.hypothesis.exceeds_min_size());
        if accepted.len() == found {
            return Some((point, all_rows));
        }
    }
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};
    use twinstep_model::Joint;

    use super::*;
    use crate::cross_validation::CandidateFit;
    use crate::hypothesis::Hypothesis;
    use crate::test_data::{Linear, data};

    /// Returns the values of viscous friction that the final fit reports for a joint with this friction [N·m·s/rad].
    fn reported(viscous: f64) -> Vec<f64> {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.1] };
        let found = CandidateFit { hypothesis, score: 50.0, gain: 0.5, explained_fraction: 1.0, threshold: 10.0 };
        let (model, mut accepted) = (ModelFile::default(), vec![(found, Vec::new())]);
        let fit = FinalFit::new(&model, &model, &mut accepted, &data(|_| viscous, None), &mut Linear);
        assert_eq!(fit.extended.effects.len(), accepted.len());
        assert_eq!(fit.drifts.len(), accepted.len());
        accepted.iter().map(|(best, _)| best.hypothesis.values[0]).collect()
    }

    /// The minimum size is 0.06 N·m·s/rad.
    #[test]
    fn cause_that_all_rows_make_too_small_is_not_reported() {
        let [value] = reported(0.1)[..] else { panic!("it is reported") };
        assert!((value - 0.1).abs() < 0.01, "{value}");
        assert!(reported(0.03).is_empty());
    }
}
