//! Displacement of a body's centre of mass.

use glam::DVec3;

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Search, Target, Variable, Visibility, demo,
};

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
    remedy: "Change a number: move the centre of mass of this link in the simulator, or check what is mounted on it.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::SLOW_SQUATS,
        over_time: PlotQuantity::Pitch,
        law: [PlotQuantity::Time, PlotQuantity::FrontShare],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    laws: &[LawForm { small: &[0.003; 3], ..LawForm::new(Place::Body, &[0.02; 3], |c, _| c.to_vec()) }],
    amount: None,
    apply: Apply::Robot(|robot, site, values| {
        crate::body(robot, site).com += DVec3::new(values[0], values[1], values[2]);
        Ok(())
    }),
};
