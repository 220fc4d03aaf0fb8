//! Final fit of the causes to all rows, with intervals.
//!
//! The held-out blocks have measured the errors by then. They contain what the other rows lack, such as fast motion.

use std::collections::BTreeSet;

use nalgebra::DMatrix;
use twinstep_effects::{ModelFile, Target};
use twinstep_identify::identify::blocks;
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::refine::{SIMULATOR_MISMATCH_STD, covariance};
use twinstep_model::{Precision, Rollout};

use super::cross_validation::{Accepted, CandidateFit, FitProblem};
use super::findings::CorrelatedPair;
use super::forward_selection::write_estimates;
use super::hypothesis::Hypothesis;
use super::reporting::TWO_SIDED_95;
use super::residual_data::ResidualData;
use super::residual_rows::ResidualRows;
use super::{joint_fit, law_shape, profile_likelihood, reporting, size_drift, unreported_effects};

/// Least distance of the size of a cause on joints from no effect, in standard errors.
///
/// There are some 400 hypotheses about joints. Of as many normal estimates without an effect, one exceeds 4 standard errors
/// with a probability of 3 %. There are few about bodies, IMU and ground: their reported interval must exclude no effect.
const LEAST_STANDARD_ERRORS: f64 = 4.0;
/// Maximum number of parts of the rows whose errors are independent.
///
/// Neighbouring blocks have the same motion, and what a law gets wrong there has the same sign in all of them: in blind
/// tests, variances of friction laws were four times as large with parts of six blocks as with single ones.
const PARTS: usize = 10;

/// Causes fitted to all rows.
pub struct FinalFit {
    /// The given model with the causes and their 95 % intervals.
    pub extended: ModelFile,
    /// Pairs of highly correlated causes.
    pub confusable: Vec<CorrelatedPair>,
    /// Values of the first parameter of each cause in the two halves of the rows, if it drifts.
    pub drifts: Vec<Option<[f64; 2]>>,
    /// Sentences about causes that are another law than the one of the catalogue that resembles it most.
    pub other_laws: String,
}

impl FinalFit {
    /// Fits `accepted` on top of `model`, whose ground is fitted in `judged`, and writes their values.
    ///
    /// Causes that the other rows have made larger than they are, so that they are now too small to report, are removed. So
    /// are those whose size is too uncertain to differ from no effect, offsets of encoders that slip, and causes whose size
    /// depends on the state of the joint.
    pub fn new(
        model: &ModelFile,
        judged: &ModelFile,
        accepted: &mut Accepted,
        evidence: &ResidualData,
        simulator: &mut dyn Rollout,
    ) -> Self {
        let (mut other_laws, mut removed) = (String::new(), Vec::new());
        let (fit, (extended, confusable)) = loop {
            let fitted = fit_to_all_rows(judged, accepted, evidence, simulator);
            let fit = joint_fit(model, accepted);
            let (Some((point, all_rows)), Some(fit)) = (fitted, fit) else {
                return Self { extended: model.clone(), confusable: Vec::new(), drifts: Vec::new(), other_laws };
            };
            let fit = FitProblem { initial_point: point, ..fit };
            let robot = fit.model(&fit.initial_point).robot_model().expect("fitted within its bounds");
            let slips = |(best, _): &(CandidateFit, _)| size_drift::slips(&best.hypothesis, evidence, &robot);
            if let Some(place) = accepted.iter().position(slips) {
                accepted.remove(place);
                continue;
            }
            let intervals = Intervals::new(&fit, &all_rows, evidence, simulator);
            let distances = intervals.distances_from_no_effect(accepted, &fit);
            let least = (0..distances.len()).min_by(|one, other| distances[*one].total_cmp(&distances[*other]));
            if let Some(place) = least.filter(|place| distances[*place] < 1.0) {
                accepted.remove(place);
                continue;
            }
            let hypotheses: Vec<&Hypothesis> = accepted.iter().map(|(best, _)| &best.hypothesis).collect();
            match law_shape::clearest_contradiction(&hypotheses, &removed, &fit, evidence, simulator) {
                Some((place, contradiction)) => {
                    other_laws += &contradiction.sentence(hypotheses[place]);
                    removed.push(hypotheses[place].scope);
                    accepted.remove(place);
                }
                None => break (fit, intervals.of_laws),
            }
        };
        let values = size_drift::drifting_values(&fit, evidence, simulator);
        let mut first = 0;
        let drifts = accepted.iter().map(|(best, _)| {
            let own = values[first];
            first += best.hypothesis.values.len();
            own
        });
        Self { extended, confusable, drifts: drifts.collect(), other_laws }
    }
}

/// Model of a fit with 95 % intervals.
struct Intervals {
    /// Intervals that include noise and nuisance parameters, with independent blocks: whether there is a cause at all.
    of_fit: ModelFile,
    /// Intervals that also include errors of the laws: common to neighbouring blocks, and of causes that are too small to be
    /// reported. With pairs of highly correlated causes.
    of_laws: (ModelFile, Vec<CorrelatedPair>),
}

impl Intervals {
    fn new(fit: &FitProblem, all_rows: &ResidualRows, evidence: &ResidualData, simulator: &mut dyn Rollout) -> Self {
        let experiments = &all_rows.experiments;
        // Without a floating base the fit has no masses and lengths, but an interval has.
        let robot = fit.model(&fit.initial_point).robot_model().ok().filter(|_| !evidence.has_free_parts());
        let of_fixed_base = robot.and_then(|robot| NuisanceModel::new(experiments, &robot, simulator));
        let [of_fit, of_laws] = fit.with_problem(all_rows, simulator, Precision::Double, |task, simulator| {
            let Some(here) = task.linearise(simulator, &fit.initial_point) else { return [None, None] };
            let tolerances = of_fixed_base.as_ref().or(all_rows.tolerances.as_ref());
            let mut errors =
                tolerances.map_or(Vec::new(), |all| all.robot_errors(task.residual_scale, task.tolerances));
            let blocks = blocks(experiments);
            let of_fit = covariance(&here, &blocks, &errors);
            errors.extend(unreported_effects::residual_changes(fit, task, evidence, simulator));
            [of_fit, covariance(&here, &in_parts(&blocks), &errors)]
        });
        let near = profile_likelihood::profile_intervals(fit, evidence, simulator);
        let with = |covariance: Option<DMatrix<f64>>| {
            reporting::with_intervals(fit, covariance.as_ref(), SIMULATOR_MISMATCH_STD, &near)
        };
        Self { of_fit: with(of_fit).0, of_laws: with(of_laws) }
    }

    /// Returns the distance of each cause's size from no effect, in units of the least with which it is reported.
    ///
    /// With several components, that of the most distant one.
    fn distances_from_no_effect(&self, accepted: &Accepted, fit: &FitProblem) -> Vec<f64> {
        let mut first = 0;
        let of_cause = |(best, _): &(CandidateFit, _)| {
            let Hypothesis { effect, scope, values } = &best.hypothesis;
            let (model, least) = match effect.target {
                Target::Joints | Target::Supply => (&self.of_fit, LEAST_STANDARD_ERRORS / TWO_SIDED_95),
                Target::Bodies | Target::Imu | Target::Ground => (&self.of_laws.0, 1.0),
            };
            let entry = model.effects.iter().rfind(|entry| entry.effect == *effect && entry.scope == *scope);
            let place = first;
            first += values.len();
            let of_component = |component: usize| {
                let (unknown, size) = (&fit.unknowns[place + component], fit.initial_point[place + component]);
                let none = unknown.coordinate(unknown.neutral);
                // The half of the interval on the side of no effect.
                let ends = entry?.intervals[component]?.map(|end| unknown.coordinate(end));
                let end = ends.into_iter().find(|end| (end - size) * (none - size) > 0.0)?;
                Some((size - none).abs() / (size - end).abs() / least)
            };
            (0..effect.parameters[0].count).filter_map(of_component).max_by(f64::total_cmp).unwrap_or(f64::INFINITY)
        };
        accepted.iter().map(of_cause).collect()
    }
}

/// Joins neighbouring blocks to at most [`PARTS`] parts, and returns the part of each row.
fn in_parts(blocks: &[usize]) -> Vec<usize> {
    let distinct: Vec<usize> = blocks.iter().copied().collect::<BTreeSet<_>>().into_iter().collect();
    let parts = distinct.len().min(PARTS);
    let part = |block: &usize| distinct.partition_point(|other| other < block) * parts / distinct.len();
    blocks.iter().map(part).collect()
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
    use crate::test_data::{Linear, data};

    /// Returns the values of viscous friction that the final fit reports for a joint with this friction in each block
    /// [N·m·s/rad].
    fn reported(viscous: impl Fn(usize) -> f64) -> Vec<f64> {
        fitted(viscous).0
    }

    /// Also returns the sentences about other laws.
    fn fitted(viscous: impl Fn(usize) -> f64) -> (Vec<f64>, String) {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.1] };
        let found = CandidateFit { hypothesis, score: 50.0, gain: 0.5, explained_fraction: 1.0, threshold: 10.0 };
        let (model, mut accepted) = (ModelFile::default(), vec![(found, Vec::new())]);
        let fit = FinalFit::new(&model, &model, &mut accepted, &data(viscous, None), &mut Linear);
        assert_eq!(fit.extended.effects.len(), accepted.len());
        assert_eq!(fit.drifts.len(), accepted.len());
        (accepted.iter().map(|(best, _)| best.hypothesis.values[0]).collect(), fit.other_laws)
    }

    /// The minimum size is 0.06 N·m·s/rad.
    #[test]
    fn cause_that_all_rows_make_too_small_is_not_reported() {
        let [value] = reported(|_| 0.1)[..] else { panic!("it is reported") };
        assert!((value - 0.1).abs() < 0.01, "{value}");
        assert!(reported(|_| 0.03).is_empty());
    }

    #[test]
    fn friction_in_one_direction_only_is_not_reported_and_a_sentence_says_why() {
        let is_forward = |row: usize| row > 0 && (0.11 * ((row - 1) % 400 + 1) as f64).cos() > 0.0;
        let (values, other_laws) = fitted(|row| if is_forward(row) { 0.6 } else { 0.0 });
        assert!(
            values.is_empty() && other_laws.starts_with(" viscous_friction@FL_hip is not reported"),
            "{other_laws}"
        );
        assert_eq!(fitted(|_| 0.3).1, "");
    }

    #[test]
    fn neighbouring_blocks_are_joined_to_ten_parts() {
        let blocks: Vec<usize> = (0..25).flat_map(|block| [4 + 2 * block; 3]).collect();
        let parts = in_parts(&blocks);
        assert_eq!((parts[0], parts.last()), (0, Some(&9)));
        assert!(
            parts.is_sorted()
                && (0..10).all(|part| [2, 3].contains(&(parts.iter().filter(|one| **one == part).count() / 3)))
        );
        assert_eq!(in_parts(&[7, 7, 3, 9]), [1, 1, 0, 2], "few blocks stay apart");
    }

    /// An unreported Coulomb friction, which moves the joint much like the viscous one, widens the interval by its size. It does not
    /// question that there is viscous friction.
    #[test]
    fn interval_of_a_friction_allows_for_a_small_one_of_another_law() {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.3] };
        let mut fit = FitProblem::new(&ModelFile::default(), &[hypothesis]).expect("a fit");
        let data = data(|_| 0.3, None);
        let all_rows = data.all_rows(&fit.model(&fit.initial_point), &mut Linear);
        fit.initial_point = fit.solve(&all_rows, &mut Linear);
        let Intervals { of_fit, of_laws } = Intervals::new(&fit, &all_rows, &data, &mut Linear);
        let [low, high] = of_laws.0.effects[0].intervals[0].expect("an interval");
        let [least, most] = of_fit.effects[0].intervals[0].expect("an interval");
        assert!(most - least < 0.7 * (high - low), "{least} to {most}, {low} to {high}");
        // A quarter of 0.15 N·m moves the joint as 0.4 * 4 / pi times as much viscous friction.
        let expected = 1.96 * 0.25 * 0.15 * 0.4 * 4.0 / std::f64::consts::PI;
        assert!(((high - low) / 2.0 / expected - 1.0).abs() < 0.15, "{low} to {high}, half of it {expected} expected");
    }

    /// Masses of 1 kg and of 0.1 kg with the same interval half of 0.4 kg; and a shift of which one component is certain.
    #[test]
    fn cause_on_a_body_differs_from_no_effect_if_the_reported_interval_of_one_component_does() {
        let distance = |name: &str, values: Vec<f64>, halves: [f64; 3]| {
            let effect = Effect::named(name).expect("in the catalogue");
            let hypothesis = Hypothesis { effect, scope: Scope::Base, values };
            let fit = FitProblem::new(&ModelFile::default(), std::slice::from_ref(&hypothesis)).expect("a fit");
            let mut model = fit.model(&fit.initial_point);
            for (component, half) in halves.into_iter().enumerate().take(effect.parameters[0].count) {
                let value = hypothesis.values[component];
                model.effects[0].intervals[component] = Some([value - half, value + half]);
            }
            let intervals = Intervals { of_fit: ModelFile::default(), of_laws: (model, Vec::new()) };
            let found = CandidateFit { hypothesis, score: 50.0, gain: 0.5, explained_fraction: 1.0, threshold: 10.0 };
            intervals.distances_from_no_effect(&vec![(found, Vec::new())], &fit)[0]
        };
        let payload = |mass: f64| distance("payload", vec![mass, 0.1, 0.0, 0.0], [0.4; 3]);
        assert!((payload(1.0) - 2.5).abs() < 1e-9, "{}", payload(1.0));
        assert!((payload(-0.1) - 0.25).abs() < 1e-9, "{}", payload(-0.1));
        let shift = |half: f64| distance("com_shift", vec![0.001, -0.02, 0.0], [0.01, half, 0.01]);
        assert!((shift(0.005) - 4.0).abs() < 1e-9, "{}", shift(0.005));
        assert!(shift(0.03) < 1.0, "{}", shift(0.03));
    }

    /// The mean over all blocks is that of a cause that is reported, but the blocks contradict each other.
    #[test]
    fn cause_whose_size_is_uncertain_is_not_reported() {
        let signs = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0];
        assert!(reported(|block| 0.1 + 0.5 * signs[block % 8]).is_empty());
    }
}
