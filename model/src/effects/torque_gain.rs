//! The motor's torque constant is not what its current says.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The motor's torque constant is not what its current says.
pub const EFFECT: Effect = Effect {
    name: "torque_gain",
    what: "The motor's torque constant is not what its current says.",
    equation: "tau_m = g tau",
    place: "10, torque constant",
    parameters: &[Parameter {
        name: "gain",
        unit: "",
        count: 1,
        bounds: [0.2, 3.0],
        plausible: [0.8, 1.2],
        neutral: 1.0,
        source: "walk-these-ways randomises motor strength by 0.9 to 1.1",
    }],
    composition: Composition::Multiply,
    target: Target::Joints,
    signature: "Motion needs more or less current than the model says, in proportion, at every speed.",
    confusions: &[
        Confusion {
            with: "torque_saturation",
            experiment: "Two amplitudes of the same motion: a gain is the same at both.",
        },
        Confusion { with: "payload", experiment: "Move a leg in the air: a payload on the trunk is not there." },
        Confusion {
            with: "coulomb_friction",
            experiment: "Holds and motion in both directions: friction changes its sign with the speed.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).drive.gain *= values[0];
        Ok(())
    },
};
