//! The drive's current follows its wish with a time constant.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The drive's current follows its wish with a time constant.
pub const EFFECT: Effect = Effect {
    name: "drive_lag",
    summary: "The drive's current follows its wish with a time constant.",
    equation: "d tau / dt = (tau_in - tau) / T",
    chain_stage: "9, bandwidth",
    parameters: &[Parameter {
        name: "time_constant_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.1],
        prior_range: [0.0, 0.015],
        no_effect_value: 0.0,
        source: "current loops and filters of such drives take 2 to 15 ms",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The torque is late and rounded: its phase lags and its amplitude falls with frequency.",
    confounders: &[
        Confounder { effect: "torque_delay", discriminating_experiment: "A chirp to high frequency: a delay keeps the amplitude." },
        Confounder { effect: "command_delay", discriminating_experiment: "A chirp to high frequency: a delay keeps the amplitude." },
        Confounder {
            effect: "armature",
            discriminating_experiment: "Compare the torque with the motion: a lag is before the torque's sensor, inertia behind it.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).actuator.torque_time_constant = values[0];
        Ok(())
    },
};
