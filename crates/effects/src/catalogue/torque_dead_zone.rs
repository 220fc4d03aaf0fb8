//! The motor produces no torque for small commanded torques.

use crate::{
    Apply, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place, PlotQuantity,
    Presence, Search, Target, Variable, Visibility, demo,
};

/// The motor produces no torque for small commanded torques.
pub const EFFECT: Effect = Effect {
    name: "torque_dead_zone",
    summary: "The motor produces no torque for small commanded torques.",
    equation: "tau <- sign(tau) max(|tau| - w, 0)",
    chain_stage: "8a, dead zone",
    parameters: &[Parameter {
        name: "half_width_nm",
        unit: "N·m",
        count: 1,
        bounds: [0.0, 10.0],
        prior_range: [0.0, 1.5],
        no_effect_value: 0.0,
        source: "current controllers with a dead band of a few percent of the rated current",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "The measured torque is zero for small commanded torques, and smaller by a constant elsewhere; the joint drifts around its setpoint.",
    confounders: &[
        Confounder {
            effect: "coulomb_friction",
            discriminating_experiment: "Push the joint by hand at zero error: friction resists, a dead zone does not. A motor-current sensor measures the dead zone only.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Two amplitudes of the same motion: a gain has the same ratio at both.",
        },
        Confounder {
            effect: "backlash",
            discriminating_experiment: "Reverse slowly under a constant load: backlash appears only where the load changes its sign.",
        },
    ],
    needs: &[DataRequirement::TorqueMeasured, DataRequirement::Reversals],
    recommended: &[],
    caveat: "",
    remedy: "Retune the robot: compensate the dead zone in the motor driver. Or add the law to the simulator.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: None,
    laws: &[LawForm {
        is_of_torque: true,
        add: Some(|joint, unknown, scale| joint.actuator.dead_zone += 1.5 * scale * unknown),
        ..LawForm::strength(Place::Drive, |c, _| vec![1.5 * c[0].max(0.0)])
    }
    .with_small(&[0.007], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.dead_zone = values[0];
        Ok(())
    }),
};
