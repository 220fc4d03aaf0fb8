//! How evident a known effect is in a log: the log-likelihood gain of its true law.

use twinstep_effects::{EffectEntry, ModelFile, Target};
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout};

use super::cross_validation::FitProblem;
use super::hypothesis::Hypothesis;
use super::residual_power::evident_channels;
use super::scan::log_likelihood_gain;
use super::{DiagnoseError, Views};

/// Returns the log-likelihood gain of `law` on top of `known`, which is everything else that is known about the robot: the larger
/// of that with its true values and that with values fitted to the logs, at least 0 [nat].
///
/// Rows and likelihood are those of [`crate::diagnose`] with `known` as the given model. There is no cross-validation, and no
/// penalty for a choice among hypotheses. The gain is infinite if the simulation diverges without the law, or the law cannot be
/// fitted.
pub fn true_law_gain(
    logs: Vec<Log>,
    known: &ModelFile,
    law: &EffectEntry,
    simulator: &mut dyn Rollout,
) -> Result<f64, DiagnoseError> {
    let Views { judged, views, .. } = match Views::new(logs, known, simulator) {
        Err(DiagnoseError::Diverges) => return Ok(f64::INFINITY),
        views => views?,
    };
    let evidence = &views[views.len() - 1].evidence;
    let hypothesis = Hypothesis { effect: law.effect, scope: law.scope, values: law.values.clone() };
    // The fitted ground would stand for the law.
    let without = if law.effect.target == Target::Ground { known } else { &judged };
    let Some(fit) = FitProblem::new(without, std::slice::from_ref(&hypothesis)) else { return Ok(f64::INFINITY) };
    let fitted = fit.solve(&evidence.fit_rows, simulator);
    let models = [without.clone(), fit.model(&fit.initial_point), fit.model(&fitted)];
    let robots = models.iter().map(ModelFile::robot_model).collect::<Result<Vec<RobotModel>, _>>()?;
    let left = evidence.residual_powers(simulator, &robots, false);
    let gain = |now| log_likelihood_gain(evidence, now, &left[0], evident_channels([law.effect.target]));
    Ok(left[1..].iter().map(gain).fold(0.0, f64::max))
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};
    use twinstep_model::Joint;

    use super::*;
    use crate::test_data::{Linear, log};

    /// Returns the gain of a viscous friction of `stated` at one joint of a robot with 0.4, of whose leg a friction of `known` is
    /// known [nat].
    fn gain(known: f64, stated: f64) -> f64 {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let joint = Joint::ALL[0];
        let entry = |scope, value| EffectEntry::new(effect, scope, vec![value]).expect("allowed");
        let known = ModelFile { effects: vec![entry(Scope::Leg(joint.leg), known)], ..ModelFile::default() };
        true_law_gain(vec![log(|_| 0.4, None)], &known, &entry(Scope::Joint(joint), stated), &mut Linear)
            .expect("a gain")
    }

    #[test]
    fn large_error_of_the_friction_is_evident_and_a_tiny_one_is_not() {
        assert!(gain(0.3, 0.4) > 50.0, "{}", gain(0.3, 0.4));
        assert!((0.0..2.0).contains(&gain(0.399, 0.4)), "{}", gain(0.399, 0.4));
    }

    /// Two simulators of a law differ: its true value need not be the best.
    #[test]
    fn law_is_refitted() {
        assert!(gain(0.3, 0.2) > 0.99 * gain(0.3, 0.4), "{} {}", gain(0.3, 0.2), gain(0.3, 0.4));
    }
}
