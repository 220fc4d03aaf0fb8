//! A cable or a spring pulls the joint towards a rest position.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "joint_spring",
    summary: "A cable or a spring pulls the joint towards a rest position.",
    equation: "-k (q - q0)",
    chain_stage: "15, link",
    parameters: &[
        Parameter {
            name: "stiffness_nm_rad",
            unit: "N·m/rad",
            count: 1,
            bounds: [0.0, 50.0],
            prior_range: [0.0, 3.0],
            no_effect_value: 0.0,
            source: "cables and hoses over a joint",
        },
        Parameter {
            name: "rest_rad",
            unit: "rad",
            count: 1,
            bounds: [-6.3, 6.3],
            prior_range: [-1.5, 1.5],
            no_effect_value: 0.0,
            source: "position at which the cable is slack",
        },
    ],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is proportional to the joint position.",
    confounders: &[
        Confounder {
            effect: "encoder_offset",
            discriminating_experiment: "Static poses at several joint angles: a spring torque grows with the angle, \
                                        an offset is the same at each.",
        },
        Confounder {
            effect: "payload",
            discriminating_experiment: "Static poses at several trunk orientations: the torque of a payload depends \
                                        on orientation, that of a spring does not.",
        },
    ],
    needs: &[DataRequirement::Range(0.5)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Add the law: a spring at these joints (`stiffness` and `springref` in MJCF). Or reroute the cable that pulls.",
    search: Search::DEFAULT,
    visibility: Visibility::LinkTorque,
    explained_by: Variable::Position,
    demo: EffectDemo {
        motion: &demo::SWING,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Position, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        ..LawForm::new(Place::Joint, &[1.5, 1.0], |c, _| {
            let stiffness = if c[0].abs() < 1e-6 { 1e-6 } else { c[0] };
            vec![stiffness, c[1] / stiffness]
        })
    }
    .with_small(&[0.05, 0.02], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        let spring = &mut joint.spring;
        spring.stiffness += values[0];
        spring.torque_offset += values[0] * values[1];
        Ok(())
    }),
};
