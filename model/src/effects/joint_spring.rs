//! A cable or a spring pulls the joint to a place.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// A cable or a spring pulls the joint to a place.
pub const EFFECT: Effect = Effect {
    name: "joint_spring",
    summary: "A cable or a spring pulls the joint to a place.",
    equation: "-k (q - q0)",
    chain_stage: "15, link",
    parameters: &[
        Parameter {
            name: "stiffness_nm_rad",
            unit: "N·m/rad",
            count: 1,
            bounds: [0.0, 50.0],
            prior_range: [0.0, 3.0],
            no_effect_value: 0.0,
            source: "cables and hoses over a joint",
        },
        Parameter {
            name: "rest_rad",
            unit: "rad",
            count: 1,
            bounds: [-6.3, 6.3],
            prior_range: [-1.5, 1.5],
            no_effect_value: 0.0,
            source: "where the cable hangs loose",
        },
    ],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is in proportion to the joint's position.",
    confounders: &[
        Confounder {
            effect: "encoder_offset",
            discriminating_experiment: "Holds at several angles: a spring's torque grows, an offset is the same.",
        },
        Confounder { effect: "payload", discriminating_experiment: "Turn the trunk: gravity turns with it, a spring does not." },
    ],
    apply: |robot, place, values| {
        let spring = &mut super::joint(robot, place).spring;
        spring.stiffness += values[0];
        spring.torque_offset += values[0] * values[1];
        Ok(())
    },
};
