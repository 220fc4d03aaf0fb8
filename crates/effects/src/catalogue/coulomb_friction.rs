//! Dry friction, independent of speed, which also holds the joint at rest.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "coulomb_friction",
    summary: "Dry friction, independent of speed, which also holds the joint at rest.",
    equation: "-c sign(dq); at dq = 0 the torque that holds the joint, up to c in magnitude",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "torque_nm",
        unit: "N·m",
        count: 1,
        bounds: [-20.0, 20.0],
        prior_range: [0.0, 1.5],
        no_effect_value: 0.0,
        source: "identified on a real Go2 with its feet in the air: 0.03 to 0.39 N·m on hips and thighs, 0.5 to 1.3 \
                 on calves",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual has a constant magnitude and the sign of the velocity. The joint sticks at reversals.",
    confounders: &[
        Confounder {
            effect: "viscous_friction",
            discriminating_experiment: "Motion at two speeds: Coulomb friction is the same at both.",
        },
        Confounder {
            effect: "stribeck_friction",
            discriminating_experiment: "Slow motion at 0.05 to 0.3 rad/s: Stribeck friction acts only at low speed.",
        },
        Confounder {
            effect: "load_friction",
            discriminating_experiment: "The same motion in the air and under load: Coulomb friction is the same.",
        },
        Confounder {
            effect: "backlash",
            discriminating_experiment: "Slow reversals without load: with backlash the link moves freely, with \
                                        friction it sticks.",
        },
    ],
    needs: &[DataRequirement::Reversals],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Add the law: dry friction (`frictionloss` in MJCF) at these joints. One joint alone: check its bearing.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Velocity,
    demo: EffectDemo {
        motion: &demo::SWING,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Velocity, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        is_usual: true,
        ..LawForm::positive(Place::Joint, &[0.6], |c, _| vec![c[0]])
    }
    .with_small(&[0.05], Presence::Everywhere)],
    amount: Some(|joint| joint.coulomb_friction),
    apply: Apply::Joint(|joint, values| {
        joint.coulomb_friction += values[0];
        Ok(())
    }),
};
