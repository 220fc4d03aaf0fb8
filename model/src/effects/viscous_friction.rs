//! Friction in proportion to speed.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// Friction in proportion to speed.
pub const EFFECT: Effect = Effect {
    name: "viscous_friction",
    what: "Friction in proportion to speed.",
    equation: "-b dq",
    place: "13, friction",
    parameters: &[Parameter {
        name: "coefficient_nms",
        unit: "N·m·s/rad",
        count: 1,
        bounds: [0.0, 5.0],
        plausible: [0.0, 0.6],
        neutral: 0.0,
        source: "unitree_mujoco has 0.1; identified robots 0.05 to 0.6",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is in proportion to the joint's speed.",
    confusions: &[
        Confusion { with: "coulomb_friction", experiment: "Two speeds: viscous friction doubles with it." },
        Confusion { with: "torque_speed_limit", experiment: "Fast motion with small torque: the limit is not there." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).viscous_friction += values[0];
        Ok(())
    },
};
