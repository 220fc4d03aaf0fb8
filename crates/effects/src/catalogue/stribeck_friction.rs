//! Additional friction near standstill that decays with speed.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Search, Shapes, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "stribeck_friction",
    summary: "Additional friction near standstill that decays with speed.",
    equation: "-F_s exp(-(dq / v_s)^2) sign(dq)",
    chain_stage: "13, friction",
    parameters: &[
        Parameter {
            name: "breakaway_nm",
            unit: "N·m",
            count: 1,
            bounds: [0.0, 20.0],
            prior_range: [0.0, 1.0],
            no_effect_value: 0.0,
            source: "published servos and gears have 0.05 to 1 N·m",
        },
        Parameter {
            name: "speed_rad_s",
            unit: "rad/s",
            count: 1,
            bounds: [0.01, 10.0],
            prior_range: [0.1, 3.0],
            no_effect_value: 0.1,
            source: "published servos and gears",
        },
    ],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "Friction is largest near standstill. Slow motion shows stick-slip.",
    confounders: &[Confounder {
        effect: "coulomb_friction",
        discriminating_experiment: "Slow motion, then fast motion: Coulomb friction is the same in both.",
    }],
    needs: &[DataRequirement::Reversals, DataRequirement::LowSpeed],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Add the law: friction that falls with speed at these joints. Slow motion needs it.",
    search: Search::DEFAULT,
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Velocity,
    demo: EffectDemo {
        motion: &demo::SWING,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Velocity, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        shapes: Shapes::Values(&[0.1, 0.2, 0.4, 0.8, 1.5, 3.0]),
        small: &[0.04],
        ..LawForm::positive(Place::Joint, &[0.5], |c, speed| vec![c[0], speed])
    }],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        let friction = &mut joint.stribeck_friction;
        if friction.breakaway_torque > 0.0 && (friction.stribeck_velocity - values[1]).abs() > 1e-9 {
            return Err("two Stribeck frictions of different `speed_rad_s` on one joint");
        }
        friction.breakaway_torque += values[0];
        friction.stribeck_velocity = values[1];
        Ok(())
    }),
};
