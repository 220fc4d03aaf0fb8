//! The centre of mass is elsewhere.

use glam::DVec3;

use super::{Composition, Confounder, Effect, Parameter, Target};

/// The centre of mass is elsewhere.
pub const EFFECT: Effect = Effect {
    name: "com_shift",
    summary: "The centre of mass is elsewhere.",
    equation: "c <- c + d, with mass and inertia about the centre as they are",
    chain_stage: "body",
    parameters: &[Parameter {
        name: "shift_m",
        unit: "m",
        count: 3,
        bounds: [-0.3, 0.3],
        prior_range: [-0.05, 0.05],
        no_effect_value: 0.0,
        source: "SPI-Active identifies up to 4 cm on the Go2",
    }],
    composition: Composition::Add,
    target: Target::Bodies,
    signature: "The feet's forces are distributed differently, and the trunk pitches or rolls more when it accelerates.",
    confounders: &[
        Confounder { effect: "payload", discriminating_experiment: "Weigh the robot." },
        Confounder { effect: "inertia", discriminating_experiment: "Quasi-static poses: inertia does not show, a shift does." },
    ],
    apply: |robot, place, values| {
        super::body(robot, place).com += DVec3::new(values[0], values[1], values[2]);
        Ok(())
    },
};
