//! Friction in proportion to the motor's torque.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// Friction in proportion to the motor's torque.
pub const EFFECT: Effect = Effect {
    name: "load_friction",
    what: "Friction in proportion to the motor's torque.",
    equation: "-mu |tau_m| sign(dq)",
    place: "13, friction",
    parameters: &[Parameter {
        name: "coefficient",
        unit: "",
        count: 1,
        bounds: [0.0, 0.8],
        plausible: [0.0, 0.25],
        neutral: 0.0,
        source: "BAM's servos: 0.05 to 0.25",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "Friction grows under load, and is not there in unloaded motion.",
    confusions: &[
        Confusion {
            with: "coulomb_friction",
            experiment: "The same motion in the air and under load: Coulomb friction is the same.",
        },
        Confusion { with: "torque_gain", experiment: "Lift and lower: friction changes its sign, a gain does not." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).load_friction += values[0];
        Ok(())
    },
};
