//! The gyroscope shows a rotation at rest.

use glam::DVec3;

use super::{Composition, Effect, Parameter, Target};

/// The gyroscope shows a rotation at rest.
pub const EFFECT: Effect = Effect {
    name: "gyro_bias",
    summary: "The gyroscope shows a rotation at rest.",
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
    target: Target::Base,
    signature: "The angular velocity is off by a constant, also at rest.",
    confounders: &[],
    apply: |robot, _, values| {
        robot.gyro_bias += DVec3::new(values[0], values[1], values[2]);
        Ok(())
    },
};
