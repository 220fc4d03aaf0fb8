//! Motor torque decreases with the motor temperature.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, EffectSite, LawForm,
    Parameter, Place, PlotQuantity, Search, Shapes, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "thermal_derating",
    summary: "Motor torque decreases with the motor temperature.",
    equation: "tau <- tau (1 - a max(T - T_ref, 0)), where T is the motor temperature",
    chain_stage: "5, heat",
    parameters: &[
        Parameter {
            name: "per_kelvin",
            unit: "1/K",
            count: 1,
            bounds: [0.0, 0.05],
            prior_range: [0.0, 0.005],
            no_effect_value: 0.0,
            source: "about 10 % of the torque per 60 K for the magnets of such motors",
        },
        Parameter {
            name: "above_c",
            unit: "°C",
            count: 1,
            bounds: [-20.0, 120.0],
            prior_range: [25.0, 45.0],
            no_effect_value: 35.0,
            source: "ambient temperature",
        },
    ],
    composition: Composition::Replace,
    target: Target::Joints,
    signature: "Torque decreases over minutes as the temperature rises, and recovers after a rest.",
    confounders: &[
        Confounder {
            effect: "supply_sag",
            discriminating_experiment: "Log battery_V and temp: derating follows the temperature of each joint, sag \
                                        follows the common voltage.",
        },
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "The same motion with cold and hot motors: a gain is the same in both.",
        },
    ],
    needs: &[DataRequirement::Torque(0.1), DataRequirement::Temperature(10.0)],
    recommended: &[DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Retune the robot: cool the motors or lower their load. Or add the law to the simulator.",
    search: Search { predictable: false, ..Search::DEFAULT },
    visibility: Visibility::MotorTorque,
    explained_by: Variable::Temperature,
    demo: EffectDemo {
        motion: &demo::HEAT,
        over_time: PlotQuantity::Height,
        law: [PlotQuantity::Temperature, PlotQuantity::DeratingFactor],
    },
    blind_test: Some(&[BlindTestCondition::Temperature, BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        shapes: Shapes::Range([25.0, 45.0, 2.5]),
        ..LawForm::positive(Place::Drive, &[0.0025], |c, above| vec![c[0].max(0.0), above])
    }],
    amount: None,
    apply: Apply::Robot(|robot, site, values| {
        if let EffectSite::Joint(index) = site {
            robot.derating.per_kelvin[index] = values[0];
            robot.derating.reference_temperature_c[index] = values[1];
        }
        Ok(())
    }),
};
