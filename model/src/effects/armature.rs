//! The rotor's inertia, seen through the gear.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The rotor's inertia, seen through the gear.
pub const EFFECT: Effect = Effect {
    name: "armature",
    summary: "The rotor's inertia, seen through the gear.",
    equation: "J_a ddq",
    chain_stage: "14, rotor",
    parameters: &[Parameter {
        name: "inertia_kgm2",
        unit: "kg·m²",
        count: 1,
        bounds: [-0.01, 0.5],
        prior_range: [0.0, 0.05],
        no_effect_value: 0.0,
        source: "a real Go2: 0.001 to 0.018 on hips and thighs, 0.017 to 0.032 on calves, beside the nominal 0.01",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is in proportion to acceleration and grows with the square of the frequency.",
    confounders: &[
        Confounder { effect: "command_delay", discriminating_experiment: "Steps of the command, and chirps of two different spectra." },
        Confounder {
            effect: "inertia",
            discriminating_experiment: "Load the leg or lock other joints: the rotor's inertia stays the same.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).armature += values[0];
        Ok(())
    },
};
