//! The motor's torque constant is not what its current says.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The motor's torque constant is not what its current says.
pub const EFFECT: Effect = Effect {
    name: "torque_gain",
    summary: "The motor's torque constant is not what its current says.",
    equation: "tau_m = g tau",
    chain_stage: "10, torque constant",
    parameters: &[Parameter {
        name: "gain",
        unit: "",
        count: 1,
        bounds: [0.2, 3.0],
        prior_range: [0.8, 1.2],
        no_effect_value: 1.0,
        source: "walk-these-ways randomises motor strength by 0.9 to 1.1",
    }],
    composition: Composition::Multiply,
    target: Target::Joints,
    signature: "Motion needs more or less current than the model says, in proportion, at every speed.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Two amplitudes of the same motion: a gain is the same at both.",
        },
        Confounder { effect: "payload", discriminating_experiment: "Move a leg in the air: a payload on the trunk is not there." },
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Holds and motion in both directions: friction changes its sign with the speed.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.gain *= values[0];
        Ok(())
    },
};
