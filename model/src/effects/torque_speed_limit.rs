//! Back-EMF leaves less torque the faster the motor turns.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// Back-EMF leaves less torque the faster the motor turns.
pub const EFFECT: Effect = Effect {
    name: "torque_speed_limit",
    summary: "Back-EMF leaves less torque the faster the motor turns.",
    equation: "|tau| <= tau_max clip(1 - dq sign(tau) / v0, 0, 1)",
    chain_stage: "8, back-EMF",
    parameters: &[Parameter {
        name: "no_load_rad_s",
        unit: "rad/s",
        count: 1,
        bounds: [2.0, 200.0],
        prior_range: [12.0, 60.0],
        no_effect_value: f64::INFINITY,
        source: "Unitree's data sheet: 30.1 rad/s for hip and thigh, 15.7 for the calf",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "At high speed the torque is clipped while it drives, and not while it brakes.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Large torque against a held joint: only saturation is left.",
        },
        Confounder {
            effect: "viscous_friction",
            discriminating_experiment: "Fast motion with small torque: friction is there, the limit is not.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.no_load_speed = values[0];
        Ok(())
    },
};
