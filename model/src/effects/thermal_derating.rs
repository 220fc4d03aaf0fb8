//! A hot motor gives less torque.

use super::{Composition, Confusion, Effect, Parameter, Place, Target};

/// A hot motor gives less torque.
pub const EFFECT: Effect = Effect {
    name: "thermal_derating",
    what: "A hot motor gives less torque.",
    equation: "tau <- tau (1 - a max(T - T_ref, 0)), by the motor's temperature",
    place: "5, heat",
    parameters: &[
        Parameter {
            name: "per_kelvin",
            unit: "1/K",
            count: 1,
            bounds: [0.0, 0.05],
            plausible: [0.0, 0.005],
            neutral: 0.0,
            source: "about 10 % in 60 K for the magnets of such motors",
        },
        Parameter {
            name: "above_c",
            unit: "°C",
            count: 1,
            bounds: [-20.0, 120.0],
            plausible: [25.0, 45.0],
            neutral: 35.0,
            source: "ambient temperature",
        },
    ],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Torque drifts down over minutes as the temperature rises, and comes back after a rest.",
    confusions: &[
        Confusion {
            with: "supply_sag",
            experiment: "Log battery_V and temp: heat follows the joint's own temperature, sag the voltage of all.",
        },
        Confusion { with: "torque_gain", experiment: "The same motion cold and hot." },
    ],
    apply: |robot, place, values| {
        if let Place::Joint(index) = place {
            robot.derating.per_kelvin[index] = values[0];
            robot.derating.above_c[index] = values[1];
        }
        Ok(())
    },
};
