//! Friction proportional to the joint velocity.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "viscous_friction",
    summary: "Friction proportional to the joint velocity.",
    equation: "-b dq",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "coefficient_nms",
        unit: "N·m·s/rad",
        count: 1,
        bounds: [-5.0, 5.0],
        prior_range: [0.0, 0.6],
        no_effect_value: 0.0,
        source: "unitree_mujoco has 0.1; identified robots 0.05 to 0.6",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is proportional to the joint velocity.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Motion at two speeds: viscous friction doubles when the speed doubles.",
        },
        Confounder {
            effect: "torque_speed_limit",
            discriminating_experiment: "Fast motion with small torque: friction acts, the limit does not.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Speed(0.03)],
    recommended: &[DataRequirement::KdVaries],
    caveat: "confounded with a wrong kd at a single kd",
    remedy: "Add the law: damping (`damping` in MJCF) at these joints. One joint alone: check its lubrication.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Velocity,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Velocity, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        is_usual: true,
        ..LawForm::positive(Place::Joint, &[0.25], |c, _| vec![c[0]])
    }
    .with_small(&[0.025], Presence::Everywhere)],
    amount: Some(|joint| joint.viscous_friction),
    apply: Apply::Joint(|joint, values| {
        joint.viscous_friction += values[0];
        Ok(())
    }),
};
