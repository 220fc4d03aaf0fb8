//! The whole loop acts late.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The whole loop acts late.
pub const EFFECT: Effect = Effect {
    name: "torque_delay",
    what: "The whole loop acts late.",
    equation: "tau(t) <- tau(t - T)",
    place: "7, loop delay",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        plausible: [0.0, 0.01],
        neutral: 0.0,
        source: "control loops of such robots take 1 to 5 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The measured torque is the wanted one of a moment ago, also for what comes from measured position and velocity; high gains ring.",
    confusions: &[
        Confusion {
            with: "command_delay",
            experiment: "Hold the command and let gravity swing the joint: only a late loop shows.",
        },
        Confusion { with: "drive_lag", experiment: "A chirp to high frequency: a lag also loses amplitude." },
        Confusion {
            with: "torque_sensor_delay",
            experiment: "Compare with the motion: a late sensor leaves it alone.",
        },
    ],
    apply: |robot, place, values| super::delayed(&mut super::joint(robot, place).drive.torque_delay, values[0]),
};
