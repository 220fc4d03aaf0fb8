//! Smooth saturation of the motor torque.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "torque_saturation",
    summary: "Smooth saturation of the motor torque.",
    equation: "tau <- kappa tanh(tau / kappa)",
    chain_stage: "3, saturation",
    parameters: &[Parameter {
        name: "kappa_nm",
        unit: "N·m",
        count: 1,
        bounds: [2.0, 200.0],
        prior_range: [15.0, 40.0],
        no_effect_value: f64::INFINITY,
        source: "SPI-Active's motor model; its identified values on the Go2 are 17 to 29 N·m",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Measured torque plotted over commanded torque saturates at both signs, at every speed.",
    confounders: &[
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "The same motion at two amplitudes: a gain is the same at both, saturation \
                                        reduces only the large one.",
        },
        Confounder {
            effect: "torque_speed_limit",
            discriminating_experiment: "Large torque on a blocked joint: at zero speed only saturation acts.",
        },
        Confounder {
            effect: "supply_sag",
            discriminating_experiment: "Move one joint alone, then all together: sag affects all joints.",
        },
    ],
    needs: &[DataRequirement::Torque(0.6)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Add the law: soft saturation of the torque in the simulator, and keep commands below it.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::THROWS,
        over_time: PlotQuantity::EstimatedTorque,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        add: Some(|joint, unknown, scale| {
            let saturation = &mut joint.actuator.saturation;
            *saturation = 1.0 / (1.0 / *saturation + unknown / (15.0 * scale));
        }),
        ..LawForm::strength(Place::Drive, |c, _| vec![15.0 / c[0].max(1e-3)])
    }
    .with_small(&[0.03], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.saturation = values[0];
        Ok(())
    }),
};
