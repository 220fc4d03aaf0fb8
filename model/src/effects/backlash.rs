//! The gear has play.

use super::{Composition, Confusion, Effect, Parameter, Target};

/// The gear has play.
pub const EFFECT: Effect = Effect {
    name: "backlash",
    what: "The gear has play.",
    equation: "no torque while |rotor - link| < gap / 2; beyond, a spring of 2000 N·m/rad or that of joint_elasticity. The encoder is at the rotor",
    place: "12, gear",
    parameters: &[Parameter {
        name: "gap_rad",
        unit: "rad",
        count: 1,
        bounds: [0.0, 0.2],
        plausible: [0.0, 0.02],
        neutral: 0.0,
        source: "0.2 to 1 degree in gears of this size",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The link moves on its own when the torque changes its sign; nothing shows in the motor's torque.",
    confusions: &[
        Confusion {
            with: "coulomb_friction",
            experiment: "Reverse slowly without load: play moves freely, friction sticks.",
        },
        Confusion {
            with: "joint_elasticity",
            experiment: "Load both ways: a spring yields in proportion, play by a fixed angle.",
        },
    ],
    apply: |robot, place, values| {
        super::joint(robot, place).drive.gap = values[0];
        Ok(())
    },
};
