//! The drive's torque levels off smoothly.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The drive's torque levels off smoothly.
pub const EFFECT: Effect = Effect {
    name: "torque_saturation",
    what: "The drive's torque levels off smoothly.",
    equation: "tau <- kappa tanh(tau / kappa)",
    place: "3, saturation",
    parameters: &[Parameter {
        name: "kappa_nm",
        unit: "N·m",
        count: 1,
        bounds: [2.0, 200.0],
        plausible: [15.0, 40.0],
        neutral: f64::INFINITY,
        source: "SPI-Active's motor model; its identified values on the Go2 are 17 to 29 N·m",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Measured over wanted torque bends towards a ceiling at both signs, whatever the speed.",
    confusions: &[
        Confusion {
            with: "torque_gain",
            experiment: "Two amplitudes of the same motion: a gain is the same at both, saturation only takes from the large one.",
        },
        Confusion {
            with: "torque_speed_limit",
            experiment: "Large torque against a held joint: without speed only saturation is left.",
        },
        Confusion {
            with: "supply_sag",
            experiment: "Move one joint alone, then all together: sag is shared by all joints.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).drive.saturation = values[0];
        Ok(())
    },
};
