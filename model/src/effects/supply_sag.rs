//! Torque falls with the battery's voltage.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// Torque falls with the battery's voltage.
pub const EFFECT: Effect = Effect {
    name: "supply_sag",
    what: "Torque falls with the battery's voltage.",
    equation: "tau <- tau (V / V_ref)^n, with the log's highest battery_V as V_ref",
    place: "4, supply",
    parameters: &[Parameter {
        name: "exponent",
        unit: "",
        count: 1,
        bounds: [0.0, 4.0],
        plausible: [0.0, 2.0],
        neutral: 0.0,
        source: "BAM's servo logs: a sagging supply explains them better than any friction model",
    }],
    composition: Composition::Replace,
    target: Target::Supply,
    signature: "All joints lose torque together, when the battery's voltage falls.",
    confusions: &[
        Confusion {
            with: "torque_saturation",
            experiment: "Move one joint alone, then all together: saturation stays with the joint.",
        },
        Confusion {
            with: "thermal_derating",
            experiment: "A short burst with a cold motor: sag is there at once, heat takes minutes.",
        },
    ],
    apply: |robot, _, values| {
        robot.derating.voltage_exponent = values[0];
        Ok(())
    },
};
