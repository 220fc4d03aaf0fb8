//! Elastic gear between rotor and link.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "joint_elasticity",
    summary: "Elastic gear between rotor and link.",
    equation: "rotor and link are two inertias, coupled by the torque k (rotor - link). The encoder is at the rotor",
    chain_stage: "12, gear",
    parameters: &[Parameter {
        name: "stiffness_nm_rad",
        unit: "N·m/rad",
        count: 1,
        bounds: [5.0, 20000.0],
        prior_range: [200.0, 2000.0],
        no_effect_value: f64::INFINITY,
        source: "harmonic and planetary gears of this size",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "A resonance, and a deflection of the link proportional to the torque.",
    confounders: &[
        Confounder {
            effect: "backlash",
            discriminating_experiment: "Loads of both signs: the deflection of backlash is constant, that of a spring \
                                        is proportional to the load.",
        },
        Confounder {
            effect: "armature",
            discriminating_experiment: "A chirp through the resonance: inertia alone has no resonance.",
        },
    ],
    needs: &[DataRequirement::Rate(500.0), DataRequirement::Bandwidth(5.0)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Add the law: a spring between rotor and link. One joint alone: check its mounting and its gear.",
    // Other contact laws, and legs that bend, imitate small values.
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::STEP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Time, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        add: Some(|joint, unknown, scale| {
            let compliance = 1.0 / joint.actuator.gear_stiffness + unknown / scale;
            joint.actuator.gear_stiffness = 1.0 / compliance;
        }),
        ..LawForm::positive(Place::Link, &[0.0025], |c, _| vec![1.0 / c[0].max(1e-6)])
    }
    .with_small(&[2.5e-4], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.gear_stiffness = values[0];
        Ok(())
    }),
};
