//! Friction in proportion to speed.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// Friction in proportion to speed.
pub const EFFECT: Effect = Effect {
    name: "viscous_friction",
    summary: "Friction in proportion to speed.",
    equation: "-b dq",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "coefficient_nms",
        unit: "N·m·s/rad",
        count: 1,
        bounds: [0.0, 5.0],
        prior_range: [0.0, 0.6],
        no_effect_value: 0.0,
        source: "unitree_mujoco has 0.1; identified robots 0.05 to 0.6",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is in proportion to the joint's speed.",
    confounders: &[
        Confounder { effect: "coulomb_friction", discriminating_experiment: "Two speeds: viscous friction doubles with it." },
        Confounder { effect: "torque_speed_limit", discriminating_experiment: "Fast motion with small torque: the limit is not there." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).viscous_friction += values[0];
        Ok(())
    },
};
