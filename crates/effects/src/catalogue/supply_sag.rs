//! Motor torque decreases with the battery voltage.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "supply_sag",
    summary: "Motor torque decreases with the battery voltage.",
    equation: "tau <- tau (V / V_ref)^n, where V_ref is the highest battery_V of the log",
    chain_stage: "4, supply",
    parameters: &[Parameter {
        name: "exponent",
        unit: "",
        count: 1,
        bounds: [0.0, 4.0],
        prior_range: [0.0, 2.0],
        no_effect_value: 0.0,
        source: "BAM's servo logs: supply sag explains them better than any friction model",
    }],
    composition: Composition::Replace,
    target: Target::Supply,
    signature: "All joints lose torque at the same time, when the battery voltage falls.",
    confounders: &[
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Move one joint alone, then all together: saturation of a joint is the same in \
                                        both, sag is not.",
        },
        Confounder {
            effect: "thermal_derating",
            discriminating_experiment: "A short burst of torque with a cold motor: sag acts at once, heating takes \
                                        minutes.",
        },
    ],
    needs: &[DataRequirement::Torque(0.4), DataRequirement::Voltage(0.5)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Retune the robot: use a charged battery, or compensate the voltage. Or add the law to the simulator.",
    search: Search { predictable: false, ..Search::DEFAULT },
    visibility: Visibility::MotorTorque,
    explained_by: Variable::Voltage,
    demo: EffectDemo {
        motion: &demo::BATTERY,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::Voltage, PlotQuantity::DeratingFactor],
    },
    blind_test: Some(&[BlindTestCondition::Voltage]),
    laws: &[LawForm::strength(Place::Supply, |c, _| vec![2.0 * c[0].max(0.0)]).with_small(&[0.01], Presence::Torques)],
    amount: None,
    apply: Apply::Robot(|robot, _, values| {
        robot.derating.voltage_exponent = values[0];
        Ok(())
    }),
};
