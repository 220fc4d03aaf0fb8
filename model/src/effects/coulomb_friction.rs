//! Friction that does not depend on speed, and holds the joint at rest.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// Friction that does not depend on speed, and holds the joint at rest.
pub const EFFECT: Effect = Effect {
    name: "coulomb_friction",
    what: "Friction that does not depend on speed, and holds the joint at rest.",
    equation: "-c sign(dq); at dq = 0 whatever holds the joint, up to c",
    place: "13, friction",
    parameters: &[Parameter {
        name: "torque_nm",
        unit: "N·m",
        count: 1,
        bounds: [0.0, 20.0],
        plausible: [0.0, 1.5],
        neutral: 0.0,
        source: "a real Go2 in the air: 0.03 to 0.39 N·m on hips and thighs, 0.5 to 1.3 on calves",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is a constant with the sign of the speed; the joint sticks at reversals.",
    confusions: &[
        Confusion { with: "viscous_friction", experiment: "Two speeds: Coulomb friction is the same at both." },
        Confusion {
            with: "stribeck_friction",
            experiment: "Creep at 0.05 to 0.3 rad/s: Stribeck friction is only there.",
        },
        Confusion { with: "load_friction", experiment: "The same motion in the air and under load." },
        Confusion { with: "backlash", experiment: "Reverse slowly without load: play moves freely, friction sticks." },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).coulomb_friction += values[0];
        Ok(())
    },
};
