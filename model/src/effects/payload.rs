//! A mass that the model does not know.

use glam::DVec3;

use super::{Composition, Confounder, Effect, Parameter, Target};

/// A mass that the model does not know.
pub const EFFECT: Effect = Effect {
    name: "payload",
    summary: "A mass that the model does not know.",
    equation: "a point mass m at r, fixed to the trunk or to a link",
    chain_stage: "body",
    parameters: &[
        Parameter {
            name: "mass_kg",
            unit: "kg",
            count: 1,
            bounds: [-3.0, 20.0],
            prior_range: [-1.0, 4.0],
            no_effect_value: 0.0,
            source: "batteries, computers and sensors that people mount",
        },
        Parameter {
            name: "position_m",
            unit: "m",
            count: 3,
            bounds: [-0.5, 0.5],
            prior_range: [-0.2, 0.2],
            no_effect_value: 0.0,
            source: "on the robot",
        },
    ],
    composition: Composition::Add,
    target: Target::Bodies,
    signature: "All feet carry more in stance, more of it where the mass is; in the air nothing changes.",
    confounders: &[
        Confounder { effect: "com_shift", discriminating_experiment: "Weigh the robot: a shift has no mass." },
        Confounder { effect: "torque_gain", discriminating_experiment: "Move a leg in the air: a gain is still there." },
    ],
    apply: |robot, place, values| {
        let body = super::body(robot, place);
        if body.mass + values[0] <= 0.0 {
            return Err("the body's mass would be zero or less");
        }
        *body = body.with_point_mass(values[0], DVec3::new(values[1], values[2], values[3]));
        Ok(())
    },
};
