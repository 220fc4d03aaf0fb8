//! The encoder's zero is not the joint's.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The encoder's zero is not the joint's.
pub const EFFECT: Effect = Effect {
    name: "encoder_offset",
    summary: "The encoder's zero is not the joint's.",
    equation: "drive and log see q + b",
    chain_stage: "2, encoder",
    parameters: &[Parameter {
        name: "offset_rad",
        unit: "rad",
        count: 1,
        bounds: [-0.2, 0.2],
        prior_range: [-0.05, 0.05],
        no_effect_value: 0.0,
        source: "walk-these-ways randomises 0.02 rad, mjlab 0.015 rad",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "In contact or under gravity the joint rests elsewhere than the model says, by the same angle at every gain and speed.",
    confounders: &[
        Confounder {
            effect: "joint_spring",
            discriminating_experiment: "Holds at several angles: an offset is the same at each, a spring's torque grows.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Holds at two position gains: a wrong torque changes with the gain, an offset does not.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.encoder_offset += values[0];
        Ok(())
    },
};
