//! Displacement of a body's centre of mass.

use glam::DVec3;

use crate::{Composition, Confounder, DataRequirement, Effect, Parameter, Target};

pub const EFFECT: Effect = Effect {
    name: "com_shift",
    summary: "Displacement of a body's centre of mass.",
    equation: "c <- c + d; mass and inertia about the centre of mass do not change",
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
    signature: "The contact forces are distributed differently over the feet. The trunk pitches or rolls more when it \
                accelerates.",
    confounders: &[
        Confounder { effect: "payload", discriminating_experiment: "Weigh the robot." },
        Confounder {
            effect: "inertia",
            discriminating_experiment: "Quasi-static poses: a shift changes the joint torques, inertia does not.",
        },
    ],
    needs: &[DataRequirement::Floating],
    recommended: &[DataRequirement::Orientation, DataRequirement::TorqueMeasured],
    caveat: "",
    apply: |robot, site, values| {
        crate::body(robot, site).com += DVec3::new(values[0], values[1], values[2]);
        Ok(())
    },
};
