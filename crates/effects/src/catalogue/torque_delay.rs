//! Delay of the torque that the PD loop computes.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "torque_delay",
    summary: "Delay of the torque that the PD loop computes.",
    equation: "tau(t) <- tau(t - T)",
    chain_stage: "7, loop delay",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.01],
        no_effect_value: 0.0,
        source: "control loops of such robots have delays of 1 to 5 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The measured torque is a delayed copy of the commanded torque, including the feedback of position and \
                velocity. High gains oscillate.",
    confounders: &[
        Confounder {
            effect: "command_delay",
            discriminating_experiment: "Constant command, joint swinging under gravity: only a torque delay has an \
                                        effect.",
        },
        Confounder {
            effect: "drive_lag",
            discriminating_experiment: "A chirp to high frequency: a lag reduces the amplitude, a delay does not.",
        },
        Confounder {
            effect: "torque_sensor_delay",
            discriminating_experiment: "Compare with the motion: a sensor delay does not change it.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Rate(200.0)],
    recommended: &[DataRequirement::Bandwidth(2.0), DataRequirement::TorqueMeasured],
    caveat: "differs from command_delay only if the joint is pushed",
    remedy: "Add the law: delay the torque of the whole loop in the simulator. Or raise the rate of the control loop.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorqueRate,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm::strength(Place::Drive, |c, _| vec![0.01 * c[0].max(0.0)]).with_small(&[0.01], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.torque_delay += values[0];
        Ok(())
    }),
};
