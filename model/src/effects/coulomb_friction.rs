//! Friction that does not depend on speed, and holds the joint at rest.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// Friction that does not depend on speed, and holds the joint at rest.
pub const EFFECT: Effect = Effect {
    name: "coulomb_friction",
    summary: "Friction that does not depend on speed, and holds the joint at rest.",
    equation: "-c sign(dq); at dq = 0 whatever holds the joint, up to c",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "torque_nm",
        unit: "N·m",
        count: 1,
        bounds: [0.0, 20.0],
        prior_range: [0.0, 1.5],
        no_effect_value: 0.0,
        source: "a real Go2 in the air: 0.03 to 0.39 N·m on hips and thighs, 0.5 to 1.3 on calves",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is a constant with the sign of the speed; the joint sticks at reversals.",
    confounders: &[
        Confounder { effect: "viscous_friction", discriminating_experiment: "Two speeds: Coulomb friction is the same at both." },
        Confounder {
            effect: "stribeck_friction",
            discriminating_experiment: "Creep at 0.05 to 0.3 rad/s: Stribeck friction is only there.",
        },
        Confounder { effect: "load_friction", discriminating_experiment: "The same motion in the air and under load." },
        Confounder { effect: "backlash", discriminating_experiment: "Reverse slowly without load: play moves freely, friction sticks." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).coulomb_friction += values[0];
        Ok(())
    },
};
