//! Compliance of the ground or of the feet.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "ground_stiffness",
    summary: "Compliance of the ground or of the feet.",
    equation: "contact is a critically damped spring with time constant T for the effective mass of the contact \
               (MuJoCo's solref)",
    chain_stage: "ground",
    parameters: &[Parameter {
        name: "time_constant_s",
        unit: "s",
        count: 1,
        bounds: [0.001, 0.2],
        prior_range: [0.002, 0.04],
        no_effect_value: 0.002,
        source: "rubber feet on floors from steel to carpet",
    }],
    composition: Composition::Replace,
    target: Target::Ground,
    signature: "Impacts last longer and the feet penetrate deeper.",
    confounders: &[Confounder {
        effect: "joint_elasticity",
        discriminating_experiment: "Push a foot of the robot with its base fixed above the ground: only elasticity \
                                    remains.",
    }],
    needs: &[DataRequirement::Floating, DataRequirement::Rate(200.0)],
    recommended: &[DataRequirement::FootContact],
    caveat: "",
    remedy: "Change a number: set the time constant of contacts (`solref` in MJCF) in the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::DROP,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::Time, PlotQuantity::Force],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    // Feet sink in proportion to the square of the time constant.
    laws: &[LawForm::positive(Place::Sink, &[0.5], |c, _| vec![0.04 * c[0].max(0.0025).sqrt()])
        .with_small(&[0.03], Presence::Torques)],
    amount: None,
    apply: Apply::Robot(|robot, _, values| {
        robot.contact.time_constant = values[0];
        Ok(())
    }),
};
