//! Whether a law has the right shape: then its size is the same in all states of a joint.
//!
//! At the joint fit the model is linear. The residuals of positions with a fixed base, and those of torques, are divided into
//! two halves by the state of their joint: the direction of its motion, its speed, its position error, or its commanded
//! position. The size of a cause is fitted to each half, with the other causes unchanged. Friction in one direction
//! resembles dry friction of half its size, but that is twice as large in this direction and zero in the other; a gain
//! that grows with the position error has different sizes at small and at large errors. Such a cause is another law than
//! the one of the catalogue that resembles it most.

use twinstep_effects::Scope;
use twinstep_model::{Joint, NUM_JOINTS, Rollout};

use super::cross_validation::{FitProblem, is_shown_in_air};
use super::hypothesis::Hypothesis;
use super::joint_samples::{STATES, Sample, VELOCITY, joint_states, position_samples, torque_samples};
use super::residual_data::ResidualData;
use super::residual_power::TORQUE;

/// Difference of two sizes from which they contradict each other [std of the difference].
const EVIDENT: f64 = 4.0;
/// Least ratio of the larger to the smaller size of another law: laws are approximations.
const RATIO: f64 = 2.0;
/// Least share of the information that is in each half.
const LEAST_SHARE: f64 = 0.2;
/// Names of the two halves of each state: velocity, speed, size of the position error, and commanded position.
const HALVES: [[&str; 2]; STATES] = [
    ["while the joint moves in its negative direction", "in its positive one"],
    ["at low speeds", "at high ones"],
    ["at small position errors", "at large ones"],
    ["in the lower part of the commanded motion", "in the upper one"],
];

/// Sizes of a cause in two halves of the rows that contradict each other.
#[derive(Clone, Debug, PartialEq)]
pub struct Contradiction {
    /// Names of the halves.
    pub halves: [&'static str; 2],
    /// The first parameter of the cause in each half.
    pub values: [f64; 2],
    /// Difference of the two sizes [std of the difference].
    distance: f64,
}

/// Returns the cause on joints whose sizes contradict each other most clearly, with its place among the causes of `fit`.
///
/// Causes on the joints of `removed` are not examined: they may now stand for the one that was removed there.
pub fn clearest_contradiction(
    hypotheses: &[&Hypothesis],
    removed: &[Scope],
    fit: &FitProblem,
    evidence: &ResidualData,
    simulator: &mut dyn Rollout,
) -> Option<(usize, Contradiction)> {
    let states: Vec<_> = evidence.logs().iter().map(joint_states).collect();
    let positions = position_samples(fit, evidence, &states, simulator);
    let mut first = 0;
    let of_cause = |(place, hypothesis): (usize, &&Hypothesis)| {
        let index = first;
        first += hypothesis.values.len();
        if !is_shown_in_air(hypothesis) || removed.iter().any(|scope| overlaps(*scope, hypothesis.scope)) {
            return None;
        }
        let torques = torque_samples(fit, index, evidence, &states);
        let found = [(&positions[index], 0), (&torques, TORQUE)]
            .into_iter()
            .filter_map(|(samples, channel)| contradiction(samples, evidence.correlation_rows(channel)))
            .filter(|one| one.exceeds_min_size(hypothesis, fit, index));
        Some((place, index, clearest(found)?))
    };
    let found = hypotheses.iter().enumerate().filter_map(of_cause);
    let (place, index, found) = found.max_by(|(.., one), (.., other)| one.distance.total_cmp(&other.distance))?;
    Some((place, found.in_units_of(fit, index)))
}

/// Returns true if two scopes have a joint in common.
fn overlaps(one: Scope, other: Scope) -> bool {
    Joint::ALL.into_iter().any(|joint| one.contains(joint) && other.contains(joint))
}

/// Returns the contradiction with the largest distance.
fn clearest(found: impl Iterator<Item = Contradiction>) -> Option<Contradiction> {
    found.max_by(|one, other| one.distance.total_cmp(&other.distance))
}

impl Contradiction {
    /// Returns true if an effect of the difference of both sizes is large enough to be reported.
    fn exceeds_min_size(&self, hypothesis: &Hypothesis, fit: &FitProblem, index: usize) -> bool {
        let own = &fit.unknowns[index..index + hypothesis.values.len()];
        let mut values: Vec<f64> = own.iter().map(|unknown| unknown.neutral).collect();
        values[0] = value(fit, index, (self.values[1] - self.values[0]).abs());
        Hypothesis { values, ..hypothesis.clone() }.exceeds_min_size()
    }

    /// Converts relative sizes of a parameter to its values.
    fn in_units_of(self, fit: &FitProblem, index: usize) -> Self {
        Self { values: self.values.map(|size| value(fit, index, size)), ..self }
    }

    /// Returns a sentence about a cause that is none.
    pub fn sentence(&self, hypothesis: &Hypothesis) -> String {
        let ([one, other], [first, second]) = (self.halves, self.values);
        let parameter = &hypothesis.effect.parameters[0];
        let unit = if parameter.unit.is_empty() { String::new() } else { format!(" {}", parameter.unit) };
        format!(
            " {} is not reported: its {} is {first:.4}{unit} {one} and {second:.4}{unit} {other}, so the true law is another one.",
            hypothesis.name(),
            parameter.name,
        )
    }
}

/// Returns the value of a parameter of a fit whose size has this ratio to that at the joint fit.
fn value(fit: &FitProblem, index: usize, size: f64) -> f64 {
    let unknown = &fit.unknowns[index];
    let neutral = unknown.coordinate(unknown.neutral);
    let [low, high] = unknown.coordinate_bounds();
    unknown.value((neutral + size * (fit.initial_point[index] - neutral)).clamp(low, high))
}

/// Returns the state of the rows that contradicts a constant size most clearly, with relative sizes. One in `correlation` of
/// the samples is independent.
fn contradiction(samples: &[Sample], correlation: f64) -> Option<Contradiction> {
    let of_state = |state: usize| {
        let [first, second] = halves(samples, state).map(|half| HalfFit::new(&half, correlation));
        let difference = first.size - second.size;
        let distance = difference.abs() / first.std.hypot(second.std);
        let [one, other] = [first, second].map(|half| half.size.abs());
        let is_other = one.max(other) > RATIO * one.min(other) || first.size * second.size < 0.0;
        let is_known =
            first.information.min(second.information) > LEAST_SHARE * (first.information + second.information);
        (distance > EVIDENT && is_other && is_known).then_some(Contradiction {
            halves: HALVES[state],
            values: [first.size, second.size],
            distance,
        })
    };
    clearest((0..STATES).filter_map(of_state))
}

/// Divides the samples of each joint by a state: the velocity at zero, others so that both halves have the same information.
fn halves(samples: &[Sample], state: usize) -> [Vec<&Sample>; 2] {
    let mut halves = [Vec::new(), Vec::new()];
    for joint in 0..NUM_JOINTS {
        let of_joint = samples.iter().filter(|sample| sample.joint == joint && sample.states[state].is_finite());
        let mut sorted: Vec<&Sample> = of_joint.collect();
        sorted.sort_by(|one, other| one.states[state].total_cmp(&other.states[state]));
        let middle = if state == VELOCITY {
            sorted.partition_point(|sample| sample.states[state] < 0.0)
        } else {
            half_of_information(&sorted)
        };
        halves[1].extend(sorted.split_off(middle));
        halves[0].extend(sorted);
    }
    halves
}

/// Returns how many samples have half of the information together, from the first.
fn half_of_information(samples: &[&Sample]) -> usize {
    let total = information(samples);
    let mut sum = 0.0;
    let reaches_half = |sample: &&Sample| {
        sum += sample.slope * sample.slope;
        sum >= 0.5 * total
    };
    samples.iter().position(reaches_half).unwrap_or(samples.len())
}

/// Returns the sum of squares of the slopes.
fn information(samples: &[&Sample]) -> f64 {
    samples.iter().map(|sample| sample.slope * sample.slope).sum()
}

/// Size that fits samples.
#[derive(Clone, Copy)]
struct HalfFit {
    /// Size, relative to that of the joint fit, and its standard deviation.
    size: f64,
    std: f64,
    information: f64,
}

impl HalfFit {
    /// Fits the size. What the fit leaves above noise and model error raises its standard deviation.
    fn new(samples: &[&Sample], correlation: f64) -> Self {
        let information = information(samples);
        let products: f64 = samples.iter().map(|sample| sample.slope * sample.residual).sum();
        let squares: f64 = samples.iter().map(|sample| sample.residual * sample.residual).sum();
        let excess = ((squares - products * products / information) / samples.len() as f64).max(1.0);
        Self { size: 1.0 - products / information, std: (correlation * excess / information).sqrt(), information }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use twinstep_effects::{Effect, ModelFile};

    use super::*;
    use crate::test_data::{Linear, data, held};

    /// Returns the contradiction of a cause whose true relative size depends on velocity and position error of two joints.
    fn of_samples(size: impl Fn([f64; STATES]) -> f64) -> Option<Contradiction> {
        let sample = |index: usize| {
            let (joint, time) = (index % 2, index as f64 / 400.0);
            let [dq, error] = [(7.0 * time).cos(), (0.9 * time).sin() * (5.0 * time).sin()];
            let states = [dq, dq.abs(), error.abs(), (7.0 * time).sin()];
            let noise = (index * 7919 % 1009) as f64 / 1009.0 - 0.5;
            let slope = 3.0 * error;
            Sample { joint, states, residual: slope * (1.0 - size(states)) + noise, slope }
        };
        contradiction(&(0..8000).map(sample).collect::<Vec<_>>(), 20.0)
    }

    fn on_first_joint(effect: &str, values: Vec<f64>) -> Hypothesis {
        let effect = Effect::named(effect).expect("in the catalogue");
        Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values }
    }

    #[test]
    fn size_of_friction_in_one_direction_differs_between_the_directions() {
        let found = of_samples(|[dq, ..]| if dq > 0.0 { 2.0 } else { 0.0 }).expect("a contradiction");
        assert_eq!(found.halves, HALVES[VELOCITY]);
        assert!(found.values[0].abs() < 0.1 && (found.values[1] - 2.0).abs() < 0.1, "{found:?}");
    }

    #[test]
    fn friction_in_one_direction_is_another_law_and_a_constant_one_is_not() {
        let hypothesis = on_first_joint("viscous_friction", vec![0.3]);
        let contradiction = |viscous: &dyn Fn(usize) -> f64| {
            let data = data(viscous, None);
            let mut fit = FitProblem::new(&ModelFile::default(), std::slice::from_ref(&hypothesis)).expect("a fit");
            fit.initial_point = fit.solve(&data.fit_rows, &mut Linear);
            clearest_contradiction(&[&hypothesis], &[], &fit, &data, &mut Linear)
        };
        // The joint moves by a sine in each window.
        let is_forward = |row: usize| row > 0 && (0.11 * ((row - 1) % 400 + 1) as f64).cos() > 0.0;
        let (place, found) = contradiction(&|row| if is_forward(row) { 0.6 } else { 0.0 }).expect("a contradiction");
        assert_eq!(place, 0);
        let sentence = found.sentence(&hypothesis);
        assert!(sentence.contains("viscous_friction@FL_hip is not reported"), "{sentence}");
        assert_eq!(contradiction(&|_| 0.3), None);
        assert_eq!(contradiction(&|_| 0.03), None, "the error is as large as the noise");
    }

    #[test]
    fn gain_that_grows_with_the_error_is_another_law_and_a_wrong_constant_one_is_not() {
        let hypothesis = on_first_joint("pd_gain", vec![1.4, 1.0]);
        let fit = FitProblem::new(&ModelFile::default(), std::slice::from_ref(&hypothesis)).expect("a fit");
        let contradiction = |torque: &dyn Fn(f64) -> f64| {
            clearest_contradiction(&[&hypothesis], &[], &fit, &held(torque), &mut Linear).map(|(_, one)| one)
        };
        assert_eq!(contradiction(&|error| 1.4 * 25.0 * error), None);
        let found = contradiction(&|error| 25.0 * (error + 7.0 * error.powi(3))).expect("a contradiction");
        assert_eq!(found.halves, HALVES[2]);
        assert!(found.values[0] < 1.3 && found.values[1] > 1.4, "{found:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// Laws are approximations: a size that is up to a half larger in one direction, or at large position errors, is none.
        #[test]
        fn size_that_is_nearly_the_same_in_all_states_is_no_contradiction(
            size in 0.1f64..3.0, forward in 1.0f64..1.5, far in 1.0f64..1.2,
        ) {
            let found = of_samples(|[dq, _, error, _]| {
                size * if dq > 0.0 { forward } else { 1.0 } * if error > 0.5 { far } else { 1.0 }
            });
            prop_assert!(found.is_none(), "{found:?}");
        }
    }
}
