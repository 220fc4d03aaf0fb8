//! The encoder's zero is not the joint's.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The encoder's zero is not the joint's.
pub const EFFECT: Effect = Effect {
    name: "encoder_offset",
    what: "The encoder's zero is not the joint's.",
    equation: "drive and log see q + b",
    place: "2, encoder",
    parameters: &[Parameter {
        name: "offset_rad",
        unit: "rad",
        count: 1,
        bounds: [-0.2, 0.2],
        plausible: [-0.05, 0.05],
        neutral: 0.0,
        source: "walk-these-ways randomises 0.02 rad, mjlab 0.015 rad",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "In contact or under gravity the joint rests elsewhere than the model says, by the same angle at every gain and speed.",
    confusions: &[
        Confusion {
            with: "joint_spring",
            experiment: "Holds at several angles: an offset is the same at each, a spring's torque grows.",
        },
        Confusion {
            with: "torque_gain",
            experiment: "Holds at two position gains: a wrong torque changes with the gain, an offset does not.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).drive.encoder_offset += values[0];
        Ok(())
    },
};
