//! The torque constant differs from the one that converts motor current to torque.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "torque_gain",
    summary: "The torque constant differs from the one that converts motor current to torque.",
    equation: "tau_m = g tau",
    chain_stage: "10, torque constant",
    parameters: &[Parameter {
        name: "gain",
        unit: "",
        count: 1,
        bounds: [0.2, 3.0],
        prior_range: [0.8, 1.2],
        no_effect_value: 1.0,
        source: "walk-these-ways randomises motor strength by 0.9 to 1.1",
    }],
    composition: Composition::Multiply,
    target: Target::Joints,
    signature: "The motion needs a constant multiple of the current that the model needs, at every speed.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "The same motion at two amplitudes: a gain is the same at both.",
        },
        Confounder {
            effect: "payload",
            discriminating_experiment: "Move a leg in the air: a payload on the trunk has no effect there.",
        },
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Static poses, and motion in both directions: friction changes sign with the \
                                        velocity.",
        },
    ],
    needs: &[DataRequirement::Reversals],
    recommended: &[DataRequirement::TorqueMeasured, DataRequirement::Torque(0.1)],
    caveat: "confounded with a wrong kp or mass",
    remedy: "Change a number: scale the torque of these motors in the simulator. Or correct the torque constant in the driver.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::EstimatedTorque, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm::new(Place::Joint, &[0.1], |c, _| vec![1.0 + c[0]]).with_small(&[0.01], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.gain *= values[0];
        Ok(())
    }),
};
