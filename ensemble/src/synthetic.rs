//! Untrained ensembles for tests and speed measurements.

use twinstep_model::stream;

use crate::ensemble::Ensemble;
use crate::metadata::EnsembleMetadata;
use crate::weights::Weights;

/// Argument of the encoder's tanh in [`Ensemble::linear_pd`] per standard deviation of torque.
const LINEAR_RANGE: f32 = 0.05;
/// Bias of an open gate. A gate with the negative bias is closed.
const OPEN: f32 = 20.0;
/// Variance of [`Ensemble::linear_pd`] before softplus: its standard deviation is an eighth of the torque's.
const VARIANCE: f32 = -4.0;
/// Relative difference of torque between consecutive members of [`Ensemble::linear_pd`].
const MEMBER_SPREAD: f32 = 0.01;

impl Ensemble {
    /// Creates an ensemble with random initial weights, different for each member.
    pub fn untrained(description: EnsembleMetadata) -> Self {
        let shape = description.shape();
        let of = |member| shape.random(&mut stream(description.seed, "weights", member));
        Self { members: (0..description.members as u64).map(of).collect(), description }
    }

    /// Creates an ensemble that computes the PD torque kp Δq + kd Δq̇, with which a robot can stand.
    ///
    /// The error is below 5 % up to three standard deviations of torque. The torque increases by 1 % per member.
    ///
    /// # Panics
    /// If there are fewer than two hidden units.
    pub fn linear_pd(description: EnsembleMetadata) -> Self {
        assert!(description.hidden >= 2, "positive and negative torques need one unit each");
        let middle = 0.5 * (description.members as f32 - 1.0);
        let of = |member: usize| pd_weights(&description, 1.0 + MEMBER_SPREAD * (member as f32 - middle));
        Self { members: (0..description.members).map(of).collect(), description }
    }
}

fn pd_weights(model: &EnsembleMetadata, scale: f32) -> Weights {
    let shape = model.shape();
    let mut weights: Weights =
        shape.layout().into_iter().map(|(name, sizes)| (name, vec![0.0; sizes.iter().product()])).collect();
    let mut set = |name: &'static str, index: usize, value: f32| {
        weights.entry(name).and_modify(|array| array[index] = value);
    };
    let ([kp, kd], scales) = (model.gains[0], model.scales);
    let [position, velocity] = scales.inputs;
    let offset = kp * position.mean + kd * velocity.mean - scales.torque.mean;
    let scaled = |torque: f64| LINEAR_RANGE * (torque / scales.torque.std) as f32;
    // The cell gate of unit 0 computes the torque; its forget gate is closed, its input and output gates are open.
    let [input, forget, cell, output] = [0, 1, 2, 3].map(|gate| gate * model.hidden);
    set("lstm.bias", input, OPEN);
    set("lstm.bias", forget, -OPEN);
    set("lstm.bias", output, OPEN);
    set("lstm.bias", cell, scaled(offset));
    set("lstm.input_weight", cell, scaled(kp * position.std));
    set("lstm.input_weight", 4 * model.hidden + cell, scaled(kd * velocity.std));
    // One unit of the head for each sign.
    for (unit, sign) in [1.0, -1.0].into_iter().enumerate() {
        set("mean.hidden.weight", unit, sign);
        set("mean.weight", unit, sign * scale / LINEAR_RANGE);
    }
    set("variance.bias", 0, VARIANCE);
    weights
}
