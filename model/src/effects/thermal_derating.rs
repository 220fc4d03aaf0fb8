//! A hot motor gives less torque.

use super::{Composition, Confounder, Effect, Parameter, EffectSite, Target};

/// A hot motor gives less torque.
pub const EFFECT: Effect = Effect {
    name: "thermal_derating",
    summary: "A hot motor gives less torque.",
    equation: "tau <- tau (1 - a max(T - T_ref, 0)), by the motor's temperature",
    chain_stage: "5, heat",
    parameters: &[
        Parameter {
            name: "per_kelvin",
            unit: "1/K",
            count: 1,
            bounds: [0.0, 0.05],
            prior_range: [0.0, 0.005],
            no_effect_value: 0.0,
            source: "about 10 % in 60 K for the magnets of such motors",
        },
        Parameter {
            name: "above_c",
            unit: "°C",
            count: 1,
            bounds: [-20.0, 120.0],
            prior_range: [25.0, 45.0],
            no_effect_value: 35.0,
            source: "ambient temperature",
        },
    ],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Torque drifts down over minutes as the temperature rises, and comes back after a rest.",
    confounders: &[
        Confounder {
            effect: "supply_sag",
            discriminating_experiment: "Log battery_V and temp: heat follows the joint's own temperature, sag the voltage of all.",
        },
        Confounder { effect: "torque_gain", discriminating_experiment: "The same motion cold and hot." },
    ],
    apply: |robot, place, values| {
        if let EffectSite::Joint(index) = place {
            robot.derating.per_kelvin[index] = values[0];
            robot.derating.reference_temperature_c[index] = values[1];
        }
        Ok(())
    },
};
