//! Back-EMF reduces the available torque with speed.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "torque_speed_limit",
    summary: "Back-EMF reduces the available torque with speed.",
    equation: "|tau| <= tau_max clip(1 - dq sign(tau) / v0, 0, 1)",
    chain_stage: "8, back-EMF",
    parameters: &[Parameter {
        name: "no_load_rad_s",
        unit: "rad/s",
        count: 1,
        bounds: [2.0, 200.0],
        prior_range: [12.0, 60.0],
        no_effect_value: f64::INFINITY,
        source: "Unitree's data sheet: 30.1 rad/s for hip and thigh, 15.7 for the calf",
    }],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "At high speed the torque is clipped while it accelerates the joint, but not while it brakes.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Large torque on a blocked joint: at zero speed only saturation acts.",
        },
        Confounder {
            effect: "viscous_friction",
            discriminating_experiment: "Fast motion with small torque: friction acts, the limit does not.",
        },
    ],
    needs: &[DataRequirement::Speed(0.5)],
    recommended: &[DataRequirement::Torque(0.5)],
    caveat: "",
    remedy: "Add the law: torque that falls with speed in the simulator. Or limit speed and torque in the controller.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::Velocity,
    demo: EffectDemo {
        motion: &demo::THROWS,
        over_time: PlotQuantity::EstimatedTorque,
        law: [PlotQuantity::Velocity, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        add: Some(|joint, unknown, _| {
            let speed = &mut joint.actuator.no_load_speed;
            *speed = 1.0 / (1.0 / *speed + unknown / 12.0);
        }),
        ..LawForm::strength(Place::Drive, |c, _| vec![12.0 / c[0].max(1e-3)])
    }
    .with_small(&[0.05], Presence::Torques)],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        joint.actuator.no_load_speed = values[0];
        Ok(())
    }),
};
