//! The ground is more or less slippery.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The ground is more or less slippery.
pub const EFFECT: Effect = Effect {
    name: "ground_friction",
    summary: "The ground is more or less slippery.",
    equation: "|f_t| <= mu f_n",
    chain_stage: "ground",
    parameters: &[Parameter {
        name: "coefficient",
        unit: "",
        count: 1,
        bounds: [0.01, 3.0],
        prior_range: [0.3, 1.2],
        no_effect_value: 0.8,
        source: "randomisation ranges of legged robots",
    }],
    composition: Composition::Replace,
    target: Target::Ground,
    signature: "Feet slip, or hold, where the model does not.",
    confounders: &[Confounder {
        effect: "payload",
        discriminating_experiment: "Push the standing robot sideways until it slips, with its weight known.",
    }],
    apply: |robot, _, values| {
        robot.contact.friction = values[0];
        Ok(())
    },
};
