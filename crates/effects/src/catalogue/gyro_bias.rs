//! Constant offset of the gyroscope.

use glam::DVec3;

use crate::{
    Apply, BlindTestCondition, Composition, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "gyro_bias",
    summary: "Constant offset of the gyroscope.",
    equation: "gyro = omega + b",
    chain_stage: "IMU",
    parameters: &[Parameter {
        name: "bias_rad_s",
        unit: "rad/s",
        count: 3,
        bounds: [-0.5, 0.5],
        prior_range: [-0.02, 0.02],
        no_effect_value: 0.0,
        source: "MEMS gyroscopes",
    }],
    composition: Composition::Add,
    target: Target::Imu,
    signature: "The measured angular velocity has a constant error, also at rest.",
    confounders: &[],
    needs: &[DataRequirement::BaseRotation(0.0)],
    recommended: &[DataRequirement::Orientation],
    caveat: "",
    remedy: "Retune the robot: average the gyroscope at rest and subtract the bias.",
    search: Search::DEFAULT,
    visibility: Visibility::Position,
    explained_by: Variable::Time,
    demo: EffectDemo {
        motion: &demo::LEAN,
        over_time: PlotQuantity::Gyro,
        law: [PlotQuantity::RollRate, PlotQuantity::Gyro],
    },
    blind_test: Some(&[BlindTestCondition::FloatingBase]),
    laws: &[LawForm::new(Place::Gyro, &[0.01; 3], |c, _| c.to_vec())],
    amount: None,
    apply: Apply::Robot(|robot, _, values| {
        robot.gyro_bias += DVec3::new(values[0], values[1], values[2]);
        Ok(())
    }),
};
