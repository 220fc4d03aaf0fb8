//! Backlash in the gear between rotor and link.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "backlash",
    summary: "Backlash in the gear between rotor and link.",
    equation: "no torque while |rotor - link| < gap / 2; outside, a spring of 2000 N·m/rad or of joint_elasticity's \
               stiffness. The encoder is at the rotor",
    chain_stage: "12, gear",
    parameters: &[Parameter {
        name: "gap_rad",
        unit: "rad",
        count: 1,
        bounds: [0.0, 0.2],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "0.2 to 1 degree in gears of this size",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The link moves freely through the backlash when the torque changes sign. The measured motor torque \
                does not show it.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Slow reversals without load: with backlash the link moves freely, with \
                                        friction it sticks.",
        },
        Confounder {
            effect: "joint_elasticity",
            discriminating_experiment: "Loads of both signs: the deflection of a spring is proportional to the load, \
                                        that of backlash is constant.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Rate(200.0)],
    recommended: &[DataRequirement::LowSpeed, DataRequirement::TorqueMeasured],
    caveat: "visible where the load changes sign",
    remedy: "Mend the robot: check the gear for wear and the joint's screws. Until then add the law to the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Time, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm::positive(Place::Link, &[0.01], |c, _| vec![c[0].max(0.0)]).with_small(&[0.002], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.backlash = values[0];
        Ok(())
    }),
};
