//! The rotor's inertia, seen through the gear.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The rotor's inertia, seen through the gear.
pub const EFFECT: Effect = Effect {
    name: "armature",
    what: "The rotor's inertia, seen through the gear.",
    equation: "J_a ddq",
    place: "14, rotor",
    parameters: &[Parameter {
        name: "inertia_kgm2",
        unit: "kg·m²",
        count: 1,
        bounds: [-0.01, 0.5],
        plausible: [0.0, 0.05],
        neutral: 0.0,
        source: "a real Go2: 0.001 to 0.018 on hips and thighs, 0.017 to 0.032 on calves, beside the nominal 0.01",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is in proportion to acceleration and grows with the square of the frequency.",
    confusions: &[
        Confusion { with: "command_delay", experiment: "Steps of the command, and chirps of two different spectra." },
        Confusion {
            with: "inertia",
            experiment: "Load the leg or lock other joints: the rotor's inertia stays the same.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).armature += values[0];
        Ok(())
    },
};
