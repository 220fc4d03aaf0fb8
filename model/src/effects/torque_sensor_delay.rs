//! A log shows the torque late; the robot is not.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// A log shows the torque late; the robot is not.
pub const EFFECT: Effect = Effect {
    name: "torque_sensor_delay",
    summary: "A log shows the torque late; the robot is not.",
    equation: "tau_measured(t) = tau(t - T)",
    chain_stage: "tap `current`",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "published logs hold torque samples for 2 to 23 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "Shifting the torque channel in time removes the error, and the simulated motion was right before.",
    confounders: &[Confounder { effect: "torque_delay", discriminating_experiment: "Compare the motion: a late loop changes it." }],
    apply: |robot, place, values| super::delayed(&mut super::joint(robot, place).actuator.sensor_delay, values[0]),
};
