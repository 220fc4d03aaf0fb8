//! The effects of the catalogue as the equations see them: unknowns, their priors, and what they change.

use std::f64::consts::PI;

use twinstep_effects::Effect;

/// Equations that an effect changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// The torque at the motor-current sensor.
    Drive,
    /// The torque at the motor-current sensors of all joints together.
    Supply,
    /// The torque on the link of a joint.
    Joint,
    /// The torque at the sensor, and when it was on the link.
    Sensor,
    /// The motion of the link, which differs from that of the encoder.
    Link,
    /// The mass of a body.
    Body,
    /// The gyroscope.
    Gyro,
}

/// An effect with its unknowns.
#[derive(Clone, Debug)]
pub struct Law {
    /// The effect.
    pub effect: &'static Effect,
    /// True if it may be named as a cause; else it is only a nuisance, because the log cannot show it.
    pub is_cause: bool,
    /// What it changes.
    pub place: Place,
    /// Prior standard deviation of each unknown, in its unit. Zero is no effect.
    pub units: Vec<f64>,
    /// True if the first unknown, or its sum with what the robot's file states, cannot be negative.
    pub is_positive: bool,
    /// Values of the only unknown that are tried, if the residuals are far from linear in it; else empty.
    pub strengths: Vec<f64>,
    /// Values that are tried of a parameter which is no unknown of its own, such as the period of a ripple; one if there is none.
    pub shapes: Vec<f64>,
    /// True if the first parameter is in proportion to the torque of a joint's motor: units and strengths are those of a Go2's.
    pub is_of_torque: bool,
    /// Returns the parameters of the effect, given the unknowns and the shape, at a joint of a Go2.
    pub values: fn(&[f64], f64) -> Vec<f64>,
}

impl Law {
    /// Returns the parameters of the effect at a joint whose motor is by a factor stronger than a Go2's.
    pub fn parameters(&self, unknowns: &[f64], shape: f64, scale: f64) -> Vec<f64> {
        let mut values = (self.values)(unknowns, shape);
        if self.is_of_torque {
            values[0] *= scale;
        }
        values
    }

    /// Returns the possible value of the first unknown that is closest to a value. A strength is never zero, where some effects are infinite.
    pub fn possible(&self, value: f64, least: f64) -> f64 {
        value.max(if self.strengths.is_empty() { least } else { LEAST_STRENGTH })
    }

    /// Returns true if the parameters of the effect are within their bounds.
    pub fn allows(&self, unknowns: &[f64], shape: f64) -> bool {
        // The parameters of other bodies depend on the body.
        let is_of_body = self.place == Place::Body;
        let bounds = self.effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one.bounds, one.count));
        is_of_body
            || (self.values)(unknowns, shape)
                .into_iter()
                .zip(bounds)
                .all(|(value, [low, high])| value >= low && value <= high)
    }
}

/// Least strength.
const LEAST_STRENGTH: f64 = 1e-3;
/// Strengths that are tried, relative to the end of the prior range.
const STRENGTHS: [f64; 12] = [0.03, 0.06, 0.1, 0.15, 0.22, 0.32, 0.45, 0.6, 0.8, 1.0, 1.25, 1.6];

/// Effects whose first parameter is a torque, or what a torque of the motor moves.
const OF_TORQUE: [&str; 9] = [
    "torque_saturation",
    "torque_dead_zone",
    "torque_ripple",
    "joint_elasticity",
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "armature",
    "joint_spring",
];

fn law(name: &str, place: Place, units: &[f64], values: fn(&[f64], f64) -> Vec<f64>) -> Law {
    let effect = Effect::named(name).expect("an effect of the catalogue");
    Law {
        effect,
        is_cause: true,
        place,
        units: units.to_vec(),
        is_positive: false,
        strengths: Vec::new(),
        shapes: vec![0.0],
        is_of_torque: OF_TORQUE.contains(&name),
        values,
    }
}

/// Returns a law of one unknown that is 1 at the end of the prior range.
fn strength(name: &str, place: Place, values: fn(&[f64], f64) -> Vec<f64>) -> Law {
    Law { is_positive: true, strengths: STRENGTHS.to_vec(), ..law(name, place, &[0.5], values) }
}

fn positive(law: Law) -> Law {
    Law { is_positive: true, ..law }
}

/// Returns the laws, in the order of the chain from command to motion.
pub fn laws() -> Vec<Law> {
    let periods = |from: f64, to: f64, step: f64| {
        let count = ((to - from) / step) as usize;
        (0..=count).map(|index| from + step * index as f64).collect::<Vec<f64>>()
    };
    vec![
        strength("command_delay", Place::Drive, |c, _| vec![0.02 * c[0].max(0.0)]),
        law("pd_gain", Place::Drive, &[0.15], |c, _| vec![1.0 + c[0], 1.0]),
        law("pd_gain", Place::Drive, &[0.3], |c, _| vec![1.0, 1.0 + c[0]]),
        law("pd_gain", Place::Drive, &[0.15, 0.3], |c, _| vec![1.0 + c[0], 1.0 + c[1]]),
        strength("torque_saturation", Place::Drive, |c, _| vec![15.0 / c[0].max(1e-3)]),
        strength("supply_sag", Place::Supply, |c, _| vec![2.0 * c[0].max(0.0)]),
        Law {
            shapes: periods(25.0, 45.0, 2.5),
            ..positive(law("thermal_derating", Place::Drive, &[0.0025], |c, above| vec![c[0].max(0.0), above]))
        },
        strength("torque_delay", Place::Drive, |c, _| vec![0.01 * c[0].max(0.0)]),
        strength("torque_speed_limit", Place::Drive, |c, _| vec![12.0 / c[0].max(1e-3)]),
        strength("torque_dead_zone", Place::Drive, |c, _| vec![1.5 * c[0].max(0.0)]),
        strength("drive_lag", Place::Drive, |c, _| vec![0.015 * c[0].max(0.0)]),
        strength("torque_sensor_delay", Place::Sensor, |c, _| vec![0.02 * c[0].max(0.0)]),
        law("torque_gain", Place::Joint, &[0.1], |c, _| vec![1.0 + c[0]]),
        Law {
            shapes: periods(6.0, 150.0, 1.5),
            ..law("torque_ripple", Place::Joint, &[0.2, 0.2], |c, cycles| {
                vec![c[0].hypot(c[1]), cycles, c[1].atan2(c[0]).clamp(-PI, PI)]
            })
        },
        positive(law("backlash", Place::Link, &[0.01], |c, _| vec![c[0].max(0.0)])),
        positive(law("joint_elasticity", Place::Link, &[0.0025], |c, _| vec![1.0 / c[0].max(1e-6)])),
        positive(law("coulomb_friction", Place::Joint, &[0.6], |c, _| vec![c[0]])),
        positive(law("viscous_friction", Place::Joint, &[0.25], |c, _| vec![c[0]])),
        Law {
            shapes: vec![0.1, 0.2, 0.4, 0.8, 1.5, 3.0],
            ..positive(law("stribeck_friction", Place::Joint, &[0.5], |c, speed| vec![c[0], speed]))
        },
        positive(law("load_friction", Place::Joint, &[0.12], |c, _| vec![c[0]])),
        positive(law("armature", Place::Joint, &[0.02], |c, _| vec![c[0]])),
        law("joint_spring", Place::Joint, &[1.5, 1.0], |c, _| {
            let stiffness = if c[0].abs() < 1e-6 { 1e-6 } else { c[0] };
            vec![stiffness, c[1] / stiffness]
        }),
        law("encoder_offset", Place::Link, &[0.025], |c, _| vec![c[0]]),
        law("payload", Place::Body, &[2.0, 0.2, 0.2, 0.2], |c, _| {
            let mass = if c[0].abs() < 1e-6 { 1e-6 } else { c[0] };
            vec![mass, c[1] / mass, c[2] / mass, c[3] / mass]
        }),
        // Second moments along the axes of the body; the parameters of the effect depend on the body.
        law("inertia", Place::Body, &[0.4, 0.4, 0.4], |c, _| c.to_vec()),
        law("com_shift", Place::Body, &[0.02, 0.02, 0.02], |c, _| c.to_vec()),
        law("gyro_bias", Place::Gyro, &[0.01, 0.01, 0.01], |c, _| c.to_vec()),
    ]
}
