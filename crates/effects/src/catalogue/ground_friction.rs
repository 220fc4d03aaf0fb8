//! Friction coefficient of the ground.

use crate::{
    Apply, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place, PlotQuantity,
    Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "ground_friction",
    summary: "Friction coefficient of the ground.",
    equation: "|f_t| <= mu f_n",
    chain_stage: "ground",
    parameters: &[Parameter {
        name: "coefficient",
        unit: "",
        count: 1,
        bounds: [0.01, 3.0],
        prior_range: [0.3, 1.2],
        no_effect_value: 0.8,
        source: "randomisation ranges of legged robots",
    }],
    composition: Composition::Replace,
    target: Target::Ground,
    signature: "The feet slip where those of the model stick, or the reverse.",
    confounders: &[Confounder {
        effect: "payload",
        discriminating_experiment: "Push the standing robot, whose weight is known, sideways until it slips.",
    }],
    needs: &[DataRequirement::Floating],
    recommended: &[DataRequirement::BasePose],
    caveat: "only slipping feet determine its value",
    remedy: "Change a number: set the friction coefficient of the ground in the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::SWAY,
        over_time: PlotQuantity::Sideways,
        law: [PlotQuantity::Time, PlotQuantity::LateralAcceleration],
    },
    blind_test: None,
    laws: &[LawForm::new(Place::Slip, &[0.3], |c, _| vec![0.8 + c[0]]).with_small(&[0.05], Presence::Torques)],
    amount: None,
    apply: Apply::Robot(|robot, _, values| {
        robot.contact.friction = values[0];
        Ok(())
    }),
};
