//! The drive's torque levels off smoothly.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The drive's torque levels off smoothly.
pub const EFFECT: Effect = Effect {
    name: "torque_saturation",
    summary: "The drive's torque levels off smoothly.",
    equation: "tau <- kappa tanh(tau / kappa)",
    chain_stage: "3, saturation",
    parameters: &[Parameter {
        name: "kappa_nm",
        unit: "N·m",
        count: 1,
        bounds: [2.0, 200.0],
        prior_range: [15.0, 40.0],
        no_effect_value: f64::INFINITY,
        source: "SPI-Active's motor model; its identified values on the Go2 are 17 to 29 N·m",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Measured over wanted torque bends towards a ceiling at both signs, whatever the speed.",
    confounders: &[
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Two amplitudes of the same motion: a gain is the same at both, saturation only takes from the large one.",
        },
        Confounder {
            effect: "torque_speed_limit",
            discriminating_experiment: "Large torque against a held joint: without speed only saturation is left.",
        },
        Confounder {
            effect: "supply_sag",
            discriminating_experiment: "Move one joint alone, then all together: sag is shared by all joints.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.saturation = values[0];
        Ok(())
    },
};
