//! Torque falls with the battery's voltage.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// Torque falls with the battery's voltage.
pub const EFFECT: Effect = Effect {
    name: "supply_sag",
    summary: "Torque falls with the battery's voltage.",
    equation: "tau <- tau (V / V_ref)^n, with the log's highest battery_V as V_ref",
    chain_stage: "4, supply",
    parameters: &[Parameter {
        name: "exponent",
        unit: "",
        count: 1,
        bounds: [0.0, 4.0],
        prior_range: [0.0, 2.0],
        no_effect_value: 0.0,
        source: "BAM's servo logs: a sagging supply explains them better than any friction model",
    }],
    composition: Composition::Replace,
    target: Target::Supply,
    signature: "All joints lose torque together, when the battery's voltage falls.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Move one joint alone, then all together: saturation stays with the joint.",
        },
        Confounder {
            effect: "thermal_derating",
            discriminating_experiment: "A short burst with a cold motor: sag is there at once, heat takes minutes.",
        },
    ],
    apply: |robot, _, values| {
        robot.derating.voltage_exponent = values[0];
        Ok(())
    },
};
