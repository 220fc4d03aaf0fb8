//! The gear has play.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The gear has play.
pub const EFFECT: Effect = Effect {
    name: "backlash",
    summary: "The gear has play.",
    equation: "no torque while |rotor - link| < gap / 2; beyond, a spring of 2000 N·m/rad or that of joint_elasticity. The encoder is at the rotor",
    chain_stage: "12, gear",
    parameters: &[Parameter {
        name: "gap_rad",
        unit: "rad",
        count: 1,
        bounds: [0.0, 0.2],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "0.2 to 1 degree in gears of this size",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The link moves on its own when the torque changes its sign; nothing shows in the motor's torque.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Reverse slowly without load: play moves freely, friction sticks.",
        },
        Confounder {
            effect: "joint_elasticity",
            discriminating_experiment: "Load both ways: a spring yields in proportion, play by a fixed angle.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.backlash = values[0];
        Ok(())
    },
};
