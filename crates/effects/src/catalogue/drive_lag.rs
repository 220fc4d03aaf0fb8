//! The motor current follows its setpoint as a first-order lag.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "drive_lag",
    summary: "The motor current follows its setpoint as a first-order lag.",
    equation: "d tau / dt = (tau_in - tau) / T",
    chain_stage: "9, bandwidth",
    parameters: &[Parameter {
        name: "time_constant_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.1],
        prior_range: [0.0, 0.015],
        no_effect_value: 0.0,
        source: "current loops and filters of actuators of this size have 2 to 15 ms",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The torque lags its setpoint and is low-pass filtered: phase lag grows and amplitude falls with \
                frequency.",
    confounders: &[
        Confounder {
            effect: "torque_delay",
            discriminating_experiment: "A chirp to high frequency: a lag reduces the amplitude, a delay does not.",
        },
        Confounder {
            effect: "command_delay",
            discriminating_experiment: "A chirp to high frequency: a lag reduces the amplitude, a delay does not.",
        },
        Confounder {
            effect: "armature",
            discriminating_experiment: "Compare the measured torque with the motion: a lag acts before the torque \
                                        sensor, inertia after it.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Rate(200.0), DataRequirement::Bandwidth(2.0)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "its gain falls with frequency, that of a delay does not",
    remedy: "Add the law: a first-order lag between commanded and actual torque. Or raise the current loop's bandwidth.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorqueRate,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        add: Some(|joint, unknown, _| joint.actuator.torque_time_constant += 0.015 * unknown),
        ..LawForm::strength(Place::Drive, |c, _| vec![0.015 * c[0].max(0.0)])
    }
    .with_small(&[0.007], Presence::Everywhere)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.torque_time_constant = values[0];
        Ok(())
    }),
};
