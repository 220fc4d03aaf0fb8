//! A body has other mass properties altogether.

use super::{Composition, Confounder, Effect, Parameter, Target};
use crate::RigidBody;

/// A body has other mass properties altogether.
pub const EFFECT: Effect = Effect {
    name: "inertia",
    summary: "A body has other mass properties altogether.",
    equation: "pseudo-inertia U U^T with U upper triangular (Rucker and Wensing 2022): positive definite for every theta",
    chain_stage: "body",
    parameters: &[Parameter {
        name: "theta",
        unit: "",
        count: 10,
        bounds: [-10.0, 10.0],
        prior_range: [-10.0, 10.0],
        no_effect_value: 0.0,
        source: "log-Cholesky coordinates alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3",
    }],
    composition: Composition::Replace,
    target: Target::Bodies,
    signature: "Accelerations and holds both differ, in ways that no single number explains.",
    confounders: &[
        Confounder { effect: "payload", discriminating_experiment: "Weigh the robot, then hang it and swing it about each axis." },
        Confounder { effect: "armature", discriminating_experiment: "Lock other joints: the rotor's inertia stays the same." },
    ],
    apply: |robot, place, values| {
        let theta: [f64; 10] = values.try_into().expect("ten values");
        *super::body(robot, place) = RigidBody::from_log_cholesky(&theta);
        Ok(())
    },
};
