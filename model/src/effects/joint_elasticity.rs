//! The gear is a spring.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The gear is a spring.
pub const EFFECT: Effect = Effect {
    name: "joint_elasticity",
    summary: "The gear is a spring.",
    equation: "rotor and link are two inertias, joined by k (rotor - link). The encoder is at the rotor",
    chain_stage: "12, gear",
    parameters: &[Parameter {
        name: "stiffness_nm_rad",
        unit: "N·m/rad",
        count: 1,
        bounds: [5.0, 20000.0],
        prior_range: [200.0, 2000.0],
        no_effect_value: f64::INFINITY,
        source: "harmonic and planetary gears of this size",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "A resonance, and a link that yields in proportion to the torque.",
    confounders: &[
        Confounder { effect: "backlash", discriminating_experiment: "Load both ways: play yields by a fixed angle." },
        Confounder { effect: "armature", discriminating_experiment: "A chirp through the resonance: inertia has none." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.gear_stiffness = values[0];
        Ok(())
    },
};
