//! Invariance of sizes: a law whose size differs between two parts of a log is not the true one, or the robot changes.
//!
//! At the joint fit the model is linear. All causes are fitted to the positions in the first and in the second half of the rows
//! with a fixed base, which have other motions: a chirp becomes faster, a motor becomes warm. Rows on the ground are left
//! out, because errors of contact differ between any two motions. An encoder offset, which the ground shows, is compared by the
//! heights of the feet in the two halves of the rows in which the robot stands.

use nalgebra::{DMatrix, DVector};
use twinstep_effects::{Scope, Target};
use twinstep_identify::least_squares::{LeastSquaresProblem, Linearisation};
use twinstep_identify::{FootHeights, OffsetChange};
use twinstep_model::{RobotModel, Rollout};

use super::cross_validation::{FitProblem, is_shown_in_air};
use super::hypothesis::Hypothesis;
use super::reporting::SIMULATOR_MISMATCH_REL_STD;
use super::residual_data::ResidualData;
use super::residual_rows::PRECISION;

/// Difference of two sizes from which a size drifts [std of the difference].
const EVIDENT: f64 = 4.0;
/// The same difference, relative to the size of the joint fit: laws are approximations.
const RELATIVE: f64 = 0.3;

/// Fit to a half of the rows, in prior units.
struct HalfFit {
    point: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// Returns the values of each free parameter that drifts, in the first and in the second half of the rows.
pub fn drifting_values(
    fit: &FitProblem,
    evidence: &ResidualData,
    simulator: &mut dyn Rollout,
) -> Vec<Option<[f64; 2]>> {
    let found = fit.with_problem(&evidence.fit_rows, simulator, PRECISION, |task, simulator| {
        let here = task.linearise(simulator, &fit.initial_point)?;
        let correlation = evidence.correlation_rows(0);
        let halves = evidence.fit_rows.halves_in_air();
        let [first, second] = halves.map(|rows| half_fit(task, &here, &fit.initial_point, &rows, correlation));
        let halves = [first?, second?];
        Some((0..fit.unknowns.len()).map(|index| drifting_value(fit, index, &halves)).collect())
    });
    found.unwrap_or_else(|| vec![None; fit.unknowns.len()])
}

/// Returns true if an encoder offset of one joint drifts: the encoder slips, which is another law. `robot` has the fitted offset.
pub fn slips(hypothesis: &Hypothesis, evidence: &ResidualData, robot: &RobotModel) -> bool {
    let Scope::Joint(joint) = hypothesis.scope else { return false };
    let is_offset = hypothesis.effect.target == Target::Joints && !is_shown_in_air(hypothesis);
    let drifts = |change: OffsetChange| {
        change.value.abs() > EVIDENT * change.std && change.value.abs() > RELATIVE * hypothesis.values[0].abs()
    };
    is_offset && evidence.logs().iter().filter_map(|log| FootHeights::new(log, robot).offset_change(joint)).any(drifts)
}

/// Returns the values of a free parameter in both halves if they differ.
fn drifting_value(fit: &FitProblem, index: usize, [first, second]: &[HalfFit; 2]) -> Option<[f64; 2]> {
    let unknown = &fit.unknowns[index];
    let size = (fit.initial_point[index] - unknown.coordinate(unknown.neutral)).abs() / unknown.prior[1];
    let difference = (first.point[index] - second.point[index]).abs();
    let variance = first.covariance[(index, index)] + second.covariance[(index, index)];
    let std = (variance + 2.0 * (SIMULATOR_MISMATCH_REL_STD * size).powi(2)).sqrt();
    let [low, high] = unknown.coordinate_bounds();
    let value =
        |half: &HalfFit| unknown.value((unknown.prior[0] + half.point[index] * unknown.prior[1]).clamp(low, high));
    (difference > EVIDENT * std && difference > RELATIVE * size).then(|| [value(first), value(second)])
}

/// Fits the linearised model to `rows`, of which one in `correlation` is independent.
fn half_fit(
    task: &LeastSquaresProblem,
    here: &Linearisation,
    point: &[f64],
    rows: &[usize],
    correlation: f64,
) -> Option<HalfFit> {
    if rows.is_empty() {
        return None;
    }
    let prior = DVector::from_iterator(point.len(), task.to_prior_units(point));
    let mut information = DMatrix::<f64>::identity(point.len(), point.len());
    let mut gradient = prior.clone();
    for row in rows {
        let slope = here.jacobian.row(*row).transpose();
        gradient.axpy(here.residuals[*row] / correlation, &slope, 1.0);
        information.ger(1.0 / correlation, &slope, &slope, 1.0);
    }
    let factor = information.cholesky()?;
    Some(HalfFit { point: prior - factor.solve(&gradient), covariance: factor.inverse() })
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, ModelFile};
    use twinstep_model::Joint;

    use super::*;
    use crate::test_data::{Linear, data, standing};

    fn drift(viscous: impl Fn(usize) -> f64) -> Option<[f64; 2]> {
        let data = data(viscous, None);
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.3] };
        let mut fit = FitProblem::new(&ModelFile::default(), &[hypothesis]).expect("a fit");
        fit.initial_point = fit.solve(&data.fit_rows, &mut Linear);
        drifting_values(&fit, &data, &mut Linear)[0]
    }

    #[test]
    fn size_that_doubles_within_a_log_drifts_and_a_constant_one_does_not() {
        assert_eq!(drift(|_| 0.3), None);
        let [first, second] = drift(|row| if row < 1600 { 0.2 } else { 0.4 }).expect("it drifts");
        assert!((first - 0.2).abs() < 0.02 && (second - 0.4).abs() < 0.02, "{first}, {second}");
    }

    #[test]
    fn offset_of_an_encoder_that_slips_drifts_and_a_constant_one_does_not() {
        let is_slip = |name: &str, value: f64, offset: &dyn Fn(f64) -> f64| {
            let effect = Effect::named(name).expect("in the catalogue");
            let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[2]), values: vec![value] };
            let fit = FitProblem::new(&ModelFile::default(), std::slice::from_ref(&hypothesis)).expect("a fit");
            let robot = fit.model(&fit.initial_point).robot_model().expect("a robot");
            slips(&hypothesis, &standing(offset), &robot)
        };
        assert!(is_slip("encoder_offset", 0.04, &|t| 0.002 * t));
        assert!(!is_slip("encoder_offset", 0.04, &|_| 0.04));
        assert!(!is_slip("viscous_friction", 0.04, &|t| 0.002 * t), "another law");
    }
}
