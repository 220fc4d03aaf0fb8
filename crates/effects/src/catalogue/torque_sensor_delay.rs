//! Delay of the logged torque; the motion is not delayed.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "torque_sensor_delay",
    summary: "Delay of the logged torque; the motion is not delayed.",
    equation: "tau_measured(t) = tau(t - T)",
    chain_stage: "tap `current`",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "published logs hold each torque sample for 2 to 23 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "A time shift of the torque channel removes the error. The simulated motion agrees without it.",
    confounders: &[Confounder {
        effect: "torque_delay",
        discriminating_experiment: "Compare the motion: a torque delay changes it.",
    }],
    needs: &[DataRequirement::TorqueMeasured, DataRequirement::Reversals, DataRequirement::Rate(200.0)],
    recommended: &[DataRequirement::Bandwidth(2.0)],
    caveat: "",
    remedy: "Change a number: read the torque estimate this much later. The motion is not affected.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorqueRate,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::EstimatedTorque,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::Torque, BlindTestCondition::FixedBase]),
    laws: &[LawForm::strength(Place::Sensor, |c, _| vec![0.02 * c[0].max(0.0)]).with_small(&[0.005], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.sensor_delay += values[0];
        Ok(())
    }),
};
