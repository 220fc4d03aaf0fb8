//! The encoder zero is offset from the joint zero.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "encoder_offset",
    summary: "The encoder zero is offset from the joint zero.",
    equation: "PD loop and log use q + b",
    chain_stage: "2, encoder",
    parameters: &[Parameter {
        name: "offset_rad",
        unit: "rad",
        count: 1,
        bounds: [-0.2, 0.2],
        prior_range: [-0.05, 0.05],
        no_effect_value: 0.0,
        source: "walk-these-ways randomises 0.02 rad, mjlab 0.015 rad",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "In contact or under gravity the joint rests at a different position than in the model, by the same \
                angle at every gain and speed.",
    confounders: &[
        Confounder {
            effect: "joint_spring",
            discriminating_experiment: "Static poses at several joint angles: an offset is the same at each, a spring \
                                        torque grows with the angle.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Static poses at two position gains: the error due to a wrong torque changes \
                                        with the gain, an offset does not.",
        },
    ],
    needs: &[DataRequirement::Reversals],
    recommended: &[DataRequirement::KpVaries],
    caveat: "confounded with a constant load at a single kp",
    remedy: "Mend the robot: calibrate the zero of these encoders. Or subtract the offset from the readings.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::Position,
    demo: EffectDemo {
        motion: &demo::SLOW_SQUATS,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::Position, PlotQuantity::Height],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    laws: &[LawForm::new(Place::Link, &[0.025], |c, _| vec![c[0]]).with_small(&[0.0015], Presence::Everywhere)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.encoder_offset += values[0];
        Ok(())
    }),
};
