//! Friction proportional to the magnitude of the motor torque.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "load_friction",
    summary: "Friction proportional to the magnitude of the motor torque.",
    equation: "-mu |tau_m| sign(dq)",
    chain_stage: "13, friction",
    parameters: &[Parameter {
        name: "coefficient",
        unit: "",
        count: 1,
        bounds: [0.0, 0.8],
        prior_range: [0.0, 0.25],
        no_effect_value: 0.0,
        source: "BAM's servos: 0.05 to 0.25",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "Friction grows with the load and vanishes without load.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "The same motion in the air and under load: Coulomb friction is the same in \
                                        both.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Lift and lower a load: friction changes sign, the error due to a gain does \
                                        not.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Torque(0.15)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "differs from coulomb_friction only under different loads",
    remedy: "Add the law: friction proportional to the transmitted torque at these joints.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Load,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::EstimatedTorque, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    laws: &[LawForm::positive(Place::Joint, &[0.12], |c, _| vec![c[0]]).with_small(&[0.005], Presence::Everywhere)],
    amount: Some(|joint| joint.load_friction),
    apply: Apply::Joint(|joint, values| {
        joint.load_friction += values[0];
        Ok(())
    }),
};
