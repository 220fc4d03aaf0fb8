//! Friction in proportion to the motor's torque.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// Friction in proportion to the motor's torque.
pub const EFFECT: Effect = Effect {
    name: "load_friction",
    summary: "Friction in proportion to the motor's torque.",
    equation: "-mu |tau_m| sign(dq)",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "coefficient",
        unit: "",
        count: 1,
        bounds: [0.0, 0.8],
        prior_range: [0.0, 0.25],
        no_effect_value: 0.0,
        source: "BAM's servos: 0.05 to 0.25",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "Friction grows under load, and is not there in unloaded motion.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "The same motion in the air and under load: Coulomb friction is the same.",
        },
        Confounder { effect: "torque_gain", discriminating_experiment: "Lift and lower: friction changes its sign, a gain does not." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).load_friction += values[0];
        Ok(())
    },
};
