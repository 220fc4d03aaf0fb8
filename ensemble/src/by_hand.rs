//! Ensembles that nobody trained: for tests, and to measure how fast they are.

use twinstep_model::stream;

use crate::ensemble::{EnsembleMetadata, Ensemble};
use crate::weights::Weights;

/// How far into its bend an encoder of [`Ensemble::of_gains`] is driven by one standard deviation of torque.
const LINEAR_RANGE: f32 = 0.05;
/// A gate with this bias is open; with its negative, closed.
const OPEN: f32 = 20.0;
/// Variance of [`Ensemble::of_gains`] before softplus: a deviation of an eighth of the torque's.
const VARIANCE: f32 = -4.0;
/// By how much neighbouring members of [`Ensemble::of_gains`] differ in torque.
const MEMBER_SPREAD: f32 = 0.01;

impl Ensemble {
    /// Networks as they are before they learn: a law without a meaning, other for each member.
    pub fn untrained(description: EnsembleMetadata) -> Self {
        let shape = description.shape();
        let of = |member| shape.random(&mut stream(description.seed, "weights", member));
        Self { members: (0..description.members as u64).map(of).collect(), description }
    }

    /// Networks that know nothing but their gains: kp Δq + kd Δq̇, within a twentieth as far as three standard deviations of
    /// torque, and 1 % stronger from member to member. A robot can stand on it.
    ///
    /// # Panics
    /// With less than two hidden units.
    pub fn linear_pd(description: EnsembleMetadata) -> Self {
        assert!(description.hidden >= 2, "the sign of a torque takes two units");
        let middle = 0.5 * (description.members as f32 - 1.0);
        let of = |member: usize| of_gains(&description, 1.0 + MEMBER_SPREAD * (member as f32 - middle));
        Self { members: (0..description.members).map(of).collect(), description }
    }
}

fn of_gains(model: &EnsembleMetadata, strength: f32) -> Weights {
    let shape = model.shape();
    let mut weights: Weights =
        shape.layout().into_iter().map(|(name, sizes)| (name, vec![0.0; sizes.iter().product()])).collect();
    let mut set = |name: &'static str, place: usize, value: f32| {
        weights.entry(name).and_modify(|array| array[place] = value);
    };
    let ([kp, kd], scales) = (model.gains[0], model.scales);
    let [position, velocity] = scales.errors;
    let offset = kp * position.mean + kd * velocity.mean - scales.torque.mean;
    let driven = |torque: f64| LINEAR_RANGE * (torque / scales.torque.std) as f32;
    // Unit 0 hears the torque at its cell's gate, remembers nothing, and lets all of it through.
    let [input, forget, cell, output] = [0, 1, 2, 3].map(|gate| gate * model.hidden);
    set("lstm.bias", input, OPEN);
    set("lstm.bias", forget, -OPEN);
    set("lstm.bias", output, OPEN);
    set("lstm.bias", cell, driven(offset));
    set("lstm.input_weight", cell, driven(kp * position.std));
    set("lstm.input_weight", 4 * model.hidden + cell, driven(kd * velocity.std));
    // One unit of the head for either sign.
    for (unit, sign) in [1.0, -1.0].into_iter().enumerate() {
        set("mean.hidden.weight", unit, sign);
        set("mean.weight", unit, sign * strength / LINEAR_RANGE);
    }
    set("variance.bias", 0, VARIANCE);
    weights
}
