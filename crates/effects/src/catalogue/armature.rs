//! Rotor inertia reflected through the gear to the joint.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "armature",
    summary: "Rotor inertia reflected through the gear to the joint.",
    equation: "J_a ddq",
    chain_stage: "14, rotor",
    parameters: &[Parameter {
        name: "inertia_kgm2",
        unit: "kg·m²",
        count: 1,
        bounds: [-0.5, 0.5],
        prior_range: [0.0, 0.05],
        no_effect_value: 0.0,
        source: "identified on a real Go2: 0.001 to 0.018 on hips and thighs, 0.017 to 0.032 on calves; nominal value \
                 0.01",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is proportional to the joint acceleration. Its amplitude grows with the square of the \
                frequency.",
    confounders: &[
        Confounder {
            effect: "command_delay",
            discriminating_experiment: "Command steps, and chirps with two different spectra.",
        },
        Confounder {
            effect: "inertia",
            discriminating_experiment: "Load the leg or lock other joints: the rotor inertia does not change.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Rate(100.0), DataRequirement::Bandwidth(1.0)],
    recommended: &[DataRequirement::Bandwidth(3.0)],
    caveat: "confounded with a delay: two spectra, or the first 10 ms of a step, discriminate",
    remedy: "Change a number: set the rotor inertia (`armature` in MJCF) of these joints in the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Acceleration,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Acceleration, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        is_usual: true,
        ..LawForm::positive(Place::Joint, &[0.02], |c, _| vec![c[0]])
    }
    .with_small(&[0.0015], Presence::Everywhere)],
    amount: Some(|joint| joint.armature),
    apply: Apply::Joint(|joint, values| {
        joint.armature += values[0];
        Ok(())
    }),
};
