//! Cross-validation: a hypothesis is fitted to one fold and evaluated on the other, in full simulation.

use nalgebra::{DMatrix, DVector};
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, Probes, Scope, Target};
use twinstep_model::{Precision, RobotModel, Rollout};

use super::hypothesis::{Hypothesis, selection_penalty};
use super::residual_data::ResidualData;
use super::residual_power::{DYNAMIC, GYRO_AT_REST, ResidualPower, TORQUE, TRUNK, evident_channels};
use super::residual_rows::{PRECISION, ResidualRows};
use twinstep_identify::least_squares::{LeastSquaresProblem, Linearisation};
use twinstep_identify::parameter::{FreeParameter, free_parameters, initial_coordinate, with_values};
use twinstep_identify::refine::{DAMPING_FACTORS, refine};

/// Maximum number of refinement steps; the scan provides a start near the minimum.
const STEPS: usize = 6;
/// Maximum number of refinement steps of a candidate that is one of several.
const TRIAL_STEPS: usize = 3;
/// Damping factors of a candidate's steps.
const TRIAL_DAMPING: [f64; 3] = [0.0, 0.1, 10.0];
/// Relative decrease of the cost below which the refinement has converged.
const SETTLED: f64 = 1e-3;

/// Cross-validated hypothesis.
#[derive(Clone, Debug)]
pub struct CandidateFit {
    /// The hypothesis with the mean of the values fitted to either fold.
    pub hypothesis: Hypothesis,
    /// Cross-validated log-likelihood gain, minus the penalties for its scope and its parameters [nat].
    pub score: f64,
    /// 1 − RMSE after / RMSE before, cross-validated in the affected channels.
    pub gain: f64,
    /// Fraction of the power above noise that it explains in the affected channels; for joints, those in the air, if it
    /// affects them there.
    pub explained_fraction: f64,
    /// Threshold that its score had to reach [nat]; of a candidate, 0.
    pub threshold: f64,
}

/// Accepted causes, each with its alternative hypotheses.
pub type Accepted = Vec<(CandidateFit, Vec<CandidateFit>)>;

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
        self.with_problem(rows, simulator, PRECISION, |task, simulator| {
            self.refined(task, simulator, &DAMPING_FACTORS, STEPS)
        })
    }

    /// Returns the points with the least cost on either fold of `rows` [coordinates].
    ///
    /// Both are steps of the model that is linearised at the fit to all rows, or to those of `fewer`. Returns `None` if the
    /// simulation diverges there.
    pub fn solve_folds(
        &self,
        rows: &ResidualRows,
        fewer: Option<&ResidualRows>,
        simulator: &mut dyn Rollout,
    ) -> Option<[Vec<f64>; 2]> {
        let steps = if self.unknowns.len() > 2 { STEPS } else { TRIAL_STEPS };
        let refined = |task: &LeastSquaresProblem, simulator: &mut dyn Rollout| {
            self.refined(task, simulator, &TRIAL_DAMPING, steps)
        };
        let of_fewer = fewer.map(|rows| self.with_problem(rows, simulator, PRECISION, refined));
        self.with_problem(rows, simulator, PRECISION, |task, simulator| {
            let whole = of_fewer.unwrap_or_else(|| refined(task, simulator));
            let here = task.linearise(simulator, &whole)?;
            let points = [0, 1].map(|fold| {
                let weight = |row: usize| rows.weight_in_fold(row, fold);
                fold_step(task, &here, &whole, weight)
            });
            let [Some(one), Some(other)] = points else { return None };
            Some([one, other])
        })
    }

    fn refined(
        &self,
        task: &LeastSquaresProblem,
        simulator: &mut dyn Rollout,
        damping: &[f64],
        most: usize,
    ) -> Vec<f64> {
        let (mut steps, mut last) = (0, f64::INFINITY);
        refine(task, simulator, damping, self.initial_point.clone(), |cost| {
            steps += 1;
            let settled = last - cost < SETTLED * cost;
            last = cost;
            steps < most && !settled
        })
    }

    /// Calls `ask` with the least-squares problem on `rows`, with residual scales estimated at the initial point.
    pub fn with_problem<R>(
        &self,
        rows: &ResidualRows,
        simulator: &mut dyn Rollout,
        precision: Precision,
        ask: impl FnOnce(&LeastSquaresProblem, &mut dyn Rollout) -> R,
    ) -> R {
        let (file, unknowns, experiments) = (&self.file, &self.unknowns[..], &rows.experiments[..]);
        let tolerances = rows.tolerances.as_ref();
        let task = LeastSquaresProblem { file, unknowns, experiments, residual_scale: &[], tolerances, precision };
        let mut spread = task.estimate_residual_scale(simulator, &self.initial_point);
        let targets: Vec<Target> = unknowns.iter().map(|unknown| unknown.effect.target).collect();
        rows.raise_scales_on_ground(&mut spread, &targets);
        let tolerances = tolerances.and_then(|tolerances| tolerances.rescaled(&spread));
        ask(&LeastSquaresProblem { residual_scale: &spread, tolerances: tolerances.as_ref(), ..task }, simulator)
    }

    /// Returns the model at a point.
    pub fn model(&self, point: &[f64]) -> ModelFile {
        with_values(&self.file, &self.unknowns, point)
    }
}

/// Cross-validates `hypothesis` on top of `model`, whose residual power is `before`.
///
/// Returns `None` if a fitted model is not a valid robot.
pub fn cross_validate(
    evidence: &ResidualData,
    model: &ModelFile,
    before: &ResidualPower,
    hypothesis: &Hypothesis,
    simulator: &mut dyn Rollout,
) -> Option<CandidateFit> {
    let fit = FitProblem::new(model, std::slice::from_ref(hypothesis))?;
    let shown_in_air = is_shown_in_air(hypothesis);
    let fewer = evidence.fixed_base_rows().filter(|_| shown_in_air);
    let points = fit.solve_folds(&evidence.fit_rows, fewer, simulator)?;
    let whole: Vec<f64> = points[0].iter().zip(&points[1]).map(|(one, other)| 0.5 * (one + other)).collect();
    let models = [fit.model(&points[0]), fit.model(&points[1]), fit.model(&whole)];
    let robots: Vec<RobotModel> = models.iter().map(|model| model.robot_model().ok()).collect::<Option<_>>()?;
    let left = evidence.residual_powers(simulator, &robots, false);
    // Fitted to one fold, evaluated on the other.
    let judged = |channel: usize| {
        let rows = evidence.correlation_rows(channel);
        left[0].log_likelihood_gain(before, channel, 1, rows) + left[1].log_likelihood_gain(before, channel, 0, rows)
    };
    let tolerated: f64 = left[..2].iter().map(|left| 0.5 * left.tolerated_gain(before)).sum();
    let channels = || evident_channels([hypothesis.effect.target]);
    let evidence_nats: f64 = channels().map(judged).sum::<f64>() + tolerated;
    let penalties = selection_penalty(hypothesis.scope) + parameter_penalty(fit.unknowns.len());
    let held_out = |channel: usize| left[0].sums[channel][1] + left[1].sums[channel][0];
    let acts: Vec<usize> = channels().filter(|channel| judged(*channel) > 1.0).collect();
    let [then, now] = [
        acts.iter().map(|channel| before.sums[*channel].iter().sum::<f64>()).sum::<f64>(),
        acts.iter().map(|channel| held_out(*channel)).sum::<f64>(),
    ];
    // What the simulator cannot follow on the ground hides nothing that rows in the air show.
    let at_rest = GYRO_AT_REST..DYNAMIC;
    let in_air: Vec<usize> =
        acts.iter().copied().filter(|channel| *channel < TRUNK || at_rest.contains(channel)).collect();
    let of_gyro = hypothesis.effect.target == Target::Imu;
    let shown_in_air = in_air
        .iter()
        .any(|channel| if of_gyro { at_rest.contains(channel) } else { shown_in_air && *channel < TORQUE });
    // A constant error of the gyroscope may be less than its noise: then it is above what the fitted model leaves.
    let below_noise = |channel: usize| {
        let [noise, fitted] = [&left[2].counts, &left[2].sums].map(|all| all[channel].iter().sum::<f64>());
        if hypothesis.effect.target == Target::Imu { (noise - fitted).max(0.0) } else { 0.0 }
    };
    let above = |now: &ResidualPower| {
        let of_channel = |channel: &usize| {
            let sum: f64 = now.sums[*channel].iter().sum();
            let noise = now.counts[*channel].iter().sum::<f64>() - below_noise(*channel);
            (sum - noise).max(0.0)
        };
        let excess = |channels: &[usize]| channels.iter().map(of_channel).sum::<f64>();
        let tolerated = if tolerated > 1.0 { now.tolerated_excess() } else { 0.0 };
        if shown_in_air { excess(&in_air) } else { excess(&acts) + tolerated }
    };
    let [above, left_above] = [above(before), above(&left[2])];
    let values = fit.unknowns.iter().zip(&whole).map(|(unknown, coordinate)| unknown.value(*coordinate)).collect();
    Some(CandidateFit {
        hypothesis: Hypothesis { values, ..hypothesis.clone() },
        score: if evidence_nats.is_finite() { evidence_nats - penalties } else { f64::NEG_INFINITY },
        gain: if then > 0.0 { 1.0 - (now / then).sqrt() } else { 0.0 },
        explained_fraction: if above > 0.0 { 1.0 - left_above / above } else { 0.0 },
        threshold: 0.0,
    })
}

/// Returns true if a hanging robot shows the effect.
pub fn is_shown_in_air(hypothesis: &Hypothesis) -> bool {
    hypothesis.effect.target == Target::Joints && matches!(hypothesis.effect.search.whole_log_probes, Probes::None)
}

/// Returns the cross-validated log-likelihood gain of `hypotheses` over `model`, minus the penalties for their scopes and
/// parameters [nat]: all are fitted together to one fold and evaluated on the other.
pub fn cross_validate_together(
    evidence: &ResidualData,
    model: &ModelFile,
    hypotheses: &[Hypothesis],
    simulator: &mut dyn Rollout,
) -> f64 {
    if hypotheses.is_empty() {
        return 0.0;
    }
    fit_together(evidence, model, hypotheses, simulator).map_or(f64::NEG_INFINITY, |(score, _)| score)
}

/// Returns the log-likelihood gain of [`cross_validate_together`] and the mean of the values fitted to either fold.
///
/// Returns `None` if a fitted model is not a valid robot.
pub fn fit_together(
    evidence: &ResidualData,
    model: &ModelFile,
    hypotheses: &[Hypothesis],
    simulator: &mut dyn Rollout,
) -> Option<(f64, Vec<f64>)> {
    let fit = FitProblem::new(model, hypotheses)?;
    let fewer = evidence.fixed_base_rows().filter(|_| hypotheses.iter().all(is_shown_in_air));
    let points = fit.solve_folds(&evidence.fit_rows, fewer, simulator)?;
    let models = [model.clone(), fit.model(&points[0]), fit.model(&points[1])];
    let robots: Vec<RobotModel> = models.iter().map(|model| model.robot_model().ok()).collect::<Option<_>>()?;
    let left = evidence.residual_powers(simulator, &robots, false);
    let judged = |channel: usize| {
        let rows = evidence.correlation_rows(channel);
        left[1].log_likelihood_gain(&left[0], channel, 1, rows)
            + left[2].log_likelihood_gain(&left[0], channel, 0, rows)
    };
    let tolerated: f64 = left[1..].iter().map(|now| 0.5 * now.tolerated_gain(&left[0])).sum();
    let penalties: f64 = hypotheses.iter().map(|hypothesis| selection_penalty(hypothesis.scope)).sum();
    let channels = evident_channels(hypotheses.iter().map(|hypothesis| hypothesis.effect.target));
    let score = channels.map(judged).sum::<f64>() + tolerated - penalties - parameter_penalty(fit.unknowns.len());
    let middle = points[0].iter().zip(&points[1]).map(|(one, other)| 0.5 * (one + other));
    Some((score, fit.unknowns.iter().zip(middle).map(|(unknown, coordinate)| unknown.value(coordinate)).collect()))
}

/// Returns the point with the least cost of the linearised model, with weights of the residuals [coordinates].
///
/// Half of the prior's information belongs to each fold.
fn fold_step(
    task: &LeastSquaresProblem,
    here: &Linearisation,
    point: &[f64],
    weight: impl Fn(usize) -> f64,
) -> Option<Vec<f64>> {
    let count = point.len();
    let prior = DVector::from_iterator(count, task.to_prior_units(point));
    let mut information = 0.5 * DMatrix::<f64>::identity(count, count);
    let mut gradient = 0.5 * &prior;
    for (row, residual) in here.residuals.iter().enumerate() {
        let weight = weight(row);
        if weight > 0.0 {
            let slope = here.jacobian.row(row).transpose();
            gradient.axpy(weight * residual, &slope, 1.0);
            information.ger(weight, &slope, &slope, 1.0);
        }
    }
    let moved = prior - information.cholesky()?.solve(&gradient);
    Some(task.from_prior_units(moved.as_slice()))
}

/// Returns the penalty for the parameters of a fit [nat].
pub fn parameter_penalty(parameters: usize) -> f64 {
    0.5 * parameters as f64 * 200f64.ln()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use twinstep_model::{Joint, go2};

    use super::*;
    use crate::forward_selection::THRESHOLD;
    use crate::test_data::{AtRest, Contact, Linear, data, data_at_rest};

    fn fit(data: &ResidualData, name: &str) -> CandidateFit {
        let effect = Effect::named(name).expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.1] };
        let before = data.residual_power(&mut Linear, &go2());
        cross_validate(data, &ModelFile::default(), &before, &hypothesis, &mut Linear).expect("a robot")
    }

    #[test]
    fn true_effect_is_accepted_with_its_size_and_explains_the_excess() {
        let data = data(|_| 0.4, None);
        let found = fit(&data, "viscous_friction");
        assert!((found.hypothesis.values[0] - 0.4).abs() < 0.01, "{:?}", found.hypothesis);
        assert!(found.score > THRESHOLD && found.explained_fraction > 0.99, "{found:?}");
        let other = fit(&data, "coulomb_friction");
        assert!(other.score < found.score && other.explained_fraction < 0.9, "{other:?}");
    }

    #[test]
    fn effect_that_is_not_there_scores_below_zero() {
        let found = fit(&data(|_| 0.0, None), "viscous_friction");
        assert!(found.score < 0.0, "{found:?}");
        assert!(!found.hypothesis.exceeds_min_size(), "{found:?}");
    }

    #[test]
    fn gyroscope_bias_below_the_noise_of_a_row_is_evident_and_explains_what_is_above_the_fitted_model() {
        let biased = gyro_bias(&data_at_rest([0.008, -0.008, 0.007], false));
        assert!((biased.hypothesis.values[1] + 0.008).abs() < 0.001, "{biased:?}");
        assert!(biased.score > THRESHOLD && biased.explained_fraction > 0.9, "{biased:?}");
        let healthy = gyro_bias(&data_at_rest([0.0; 3], false));
        assert!(healthy.score < 0.0, "{healthy:?}");
    }

    /// Shaking feet hide a bias of a fifth of the noise of a row, but the same log shows it while the robot hangs.
    #[test]
    fn small_gyroscope_bias_is_evident_while_the_robot_hangs() {
        let biased = gyro_bias(&data_at_rest([-0.004, 0.001, 0.0], true));
        assert!((biased.hypothesis.values[0] + 0.004).abs() < 0.001, "{biased:?}");
        assert!(biased.score > THRESHOLD && biased.explained_fraction > 0.9, "{biased:?}");
        let healthy = gyro_bias(&data_at_rest([0.0; 3], true));
        assert!(healthy.score < 0.0, "{healthy:?}");
    }

    fn gyro_bias(data: &ResidualData) -> CandidateFit {
        let effect = Effect::named("gyro_bias").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Base, values: vec![0.001; 3] };
        let before = data.residual_power(&mut AtRest, &go2());
        cross_validate(data, &ModelFile::default(), &before, &hypothesis, &mut AtRest).expect("a robot")
    }

    #[test]
    fn contact_that_cancels_the_trace_of_a_cause_does_not_refute_it() {
        let contact = Contact { seconds: 22, amplitude: 0.01624, hz: 2.788, seed: 443 };
        let [air, both] = [None, Some(contact)].map(|contact| fit(&data(|_| 0.2, contact), "viscous_friction"));
        assert!(both.score > 0.95 * air.score, "{} -> {} nat", air.score, both.score);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// Rows that the simulator cannot follow count for little, however many they are.
        #[test]
        fn cause_that_rows_in_the_air_support_is_not_lost_with_rows_on_the_ground(
            seconds in 5usize..60, amplitude in 0.0f64..0.1, hz in 0.5f64..6.0, seed in 1u32..1000,
        ) {
            let contact = Contact { seconds, amplitude, hz, seed };
            let [air, both] = [None, Some(contact)].map(|contact| fit(&data(|_| 0.2, contact), "viscous_friction"));
            prop_assert!(both.score > 0.9 * air.score, "{} -> {} nat", air.score, both.score);
            prop_assert!(both.explained_fraction > 0.3, "{both:?}");
            prop_assert!((both.hypothesis.values[0] - 0.2).abs() < 0.02, "{:?}", both.hypothesis);
        }
    }
}
