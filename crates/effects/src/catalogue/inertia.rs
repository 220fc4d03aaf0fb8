//! Replaces all ten inertial parameters of a body.

use crate::{
    Apply, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place, PlotQuantity,
    Search, Target, Variable, Visibility, demo,
};
use twinstep_model::RigidBody;

pub const EFFECT: Effect = Effect {
    name: "inertia",
    summary: "Replaces all ten inertial parameters of a body.",
    equation: "pseudo-inertia U U^T with U upper triangular (Rucker and Wensing 2022): positive definite for every \
               theta",
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
    signature: "Both dynamic and static torques have residuals that no single parameter explains.",
    confounders: &[
        Confounder {
            effect: "payload",
            discriminating_experiment: "Weigh the robot, then suspend it and let it swing about each axis.",
        },
        Confounder {
            effect: "armature",
            discriminating_experiment: "Lock other joints: the rotor inertia does not change.",
        },
    ],
    needs: &[DataRequirement::Floating, DataRequirement::BaseRotation(1.0)],
    recommended: &[DataRequirement::Orientation],
    caveat: "",
    remedy: "Change a number: set the mass, centre of mass and inertia of this link in the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::SQUATS,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::VerticalAcceleration, PlotQuantity::Force],
    },
    blind_test: None,
    laws: &[LawForm {
        // A second moment is the sum of two moments of inertia minus the third, half of it.
        small: &[0.08; 3],
        // Second moments along the axes of the body; the parameters of the effect depend on the body.
        ..LawForm::new(Place::Body, &[0.4; 3], |c, _| c.to_vec())
    }],
    amount: None,
    apply: Apply::Robot(|robot, site, values| {
        let theta: [f64; 10] = values.try_into().expect("ten values");
        *crate::body(robot, site) = RigidBody::from_log_cholesky(&theta);
        Ok(())
    }),
};
