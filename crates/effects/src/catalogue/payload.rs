//! Additional point mass on the trunk or a link.

use glam::DVec3;

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "payload",
    summary: "Additional point mass on the trunk or a link.",
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
            source: "typical mounted batteries, computers and sensors",
        },
        Parameter {
            name: "position_m",
            unit: "m",
            count: 3,
            bounds: [-0.5, 0.5],
            prior_range: [-0.2, 0.2],
            no_effect_value: 0.0,
            source: "extent of the robot",
        },
    ],
    composition: Composition::Add,
    target: Target::Bodies,
    signature: "In stance all feet carry more weight, most of it near the mass. With the feet in the air nothing \
                changes.",
    confounders: &[
        Confounder {
            effect: "com_shift",
            discriminating_experiment: "Weigh the robot: a shift does not change its weight.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Move a leg in the air: a gain still acts, a payload on the trunk does not.",
        },
    ],
    needs: &[DataRequirement::Floating],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "a load on a leg is also identifiable with a fixed base",
    remedy: "Change a number: add this mass at this position in the simulator, or remove it from the robot.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::SQUATS,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::VerticalAcceleration, PlotQuantity::Force],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    laws: &[LawForm::new(Place::Body, &[2.0, 0.2, 0.2, 0.2], |c, _| {
        let mass = if c[0].abs() < 1e-6 { 1e-6 } else { c[0] };
        vec![mass, c[1] / mass, c[2] / mass, c[3] / mass]
    })],
    amount: None,
    apply: Apply::Robot(|robot, site, values| {
        let body = crate::body(robot, site);
        if body.mass + values[0] <= 0.0 {
            return Err("the body's mass would be zero or less");
        }
        *body = body.with_point_mass(values[0], DVec3::new(values[1], values[2], values[3]));
        Ok(())
    }),
};
