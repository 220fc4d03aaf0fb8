//! The drive receives its commands late.

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The drive receives its commands late.
pub const EFFECT: Effect = Effect {
    name: "command_delay",
    summary: "The drive receives its commands late.",
    equation: "q_cmd, dq_cmd and tau_ff of time t - T reach the drive at t; between two commands by linear interpolation",
    chain_stage: "1, command",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "walk-these-ways randomises 0 to 30 ms; PACE allows 25 ms; real Go2 logs gave 1 to 6 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The torque follows the command's changes late, with a phase that grows linearly with frequency; measured position and velocity are not late.",
    confounders: &[
        Confounder {
            effect: "armature",
            discriminating_experiment: "Steps of the command: within the delay nothing moves at all, while inertia starts at once and slowly; and chirps of two different spectra.",
        },
        Confounder {
            effect: "drive_lag",
            discriminating_experiment: "A chirp to high frequency: a lag also loses amplitude, a delay does not.",
        },
        Confounder {
            effect: "torque_delay",
            discriminating_experiment: "Hold the command and push the joint by hand or let gravity swing it: a late command shows nothing, a late loop does.",
        },
    ],
    apply: |robot, place, values| super::delayed(&mut super::joint(robot, place).actuator.command_delay, values[0]),
};
