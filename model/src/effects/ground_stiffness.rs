//! The ground or the foot is softer.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The ground or the foot is softer.
pub const EFFECT: Effect = Effect {
    name: "ground_stiffness",
    summary: "The ground or the foot is softer.",
    equation: "contact as a critically damped spring of time constant T at the contact's effective mass (MuJoCo's solref)",
    chain_stage: "ground",
    parameters: &[Parameter {
        name: "time_constant_s",
        unit: "s",
        count: 1,
        bounds: [0.001, 0.2],
        prior_range: [0.002, 0.04],
        no_effect_value: 0.002,
        source: "rubber feet on floors from steel to carpet",
    }],
    composition: Composition::Replace,
    target: Target::Ground,
    signature: "Impacts last longer and the feet sink in.",
    confounders: &[Confounder {
        effect: "joint_elasticity",
        discriminating_experiment: "Push a foot of the hanging robot: the ground is not there.",
    }],
    apply: |robot, _, values| {
        robot.contact.time_constant = values[0];
        Ok(())
    },
};
