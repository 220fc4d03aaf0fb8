//! The whole loop acts late.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The whole loop acts late.
pub const EFFECT: Effect = Effect {
    name: "torque_delay",
    summary: "The whole loop acts late.",
    equation: "tau(t) <- tau(t - T)",
    chain_stage: "7, loop delay",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.01],
        no_effect_value: 0.0,
        source: "control loops of such robots take 1 to 5 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The measured torque is the wanted one of a moment ago, also for what comes from measured position and velocity; high gains ring.",
    confounders: &[
        Confounder {
            effect: "command_delay",
            discriminating_experiment: "Hold the command and let gravity swing the joint: only a late loop shows.",
        },
        Confounder { effect: "drive_lag", discriminating_experiment: "A chirp to high frequency: a lag also loses amplitude." },
        Confounder {
            effect: "torque_sensor_delay",
            discriminating_experiment: "Compare with the motion: a late sensor leaves it alone.",
        },
    ],
    apply: |robot, place, values| super::delayed(&mut super::joint(robot, place).actuator.torque_delay, values[0]),
};
