//! An effect as equations of motion see it: unknowns in which it is nearly linear, with their priors.
//!
//! Diagnosis compares the evidence of [`LawForm`]s. An effect may have several, such as either gain alone and both.

use twinstep_model::JointModel;

/// Equations that an effect changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
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
    /// The force on feet that slide.
    Slip,
    /// The height of feet that stand.
    Sink,
}

/// Where every joint has a little of an effect, too little to report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Presence {
    /// Nowhere: other unknowns stand for it.
    Nowhere,
    /// In equations of torques.
    Torques,
    /// In equations of torques and in simulated positions.
    Everywhere,
}

/// Values of a parameter that is no unknown of its own, such as the period of a ripple.
#[derive(Clone, Copy, Debug)]
pub enum Shapes {
    /// There is no such parameter.
    None,
    /// These values.
    Values(&'static [f64]),
    /// Values at equal distances: first, largest, distance.
    Range([f64; 3]),
}

impl Shapes {
    /// Returns the values; one zero if there is no such parameter.
    pub fn values(self) -> Vec<f64> {
        match self {
            Self::None => vec![0.0],
            Self::Values(values) => values.to_vec(),
            Self::Range([from, to, step]) => {
                let count = ((to - from) / step) as usize;
                (0..=count).map(|index| from + step * index as f64).collect()
            }
        }
    }
}

/// An effect in unknowns that are zero without it.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::struct_excessive_bools, reason = "each is a property of its own, and most laws have none of them")]
pub struct LawForm {
    /// What it changes.
    pub place: Place,
    /// Prior standard deviation of each unknown, in its unit.
    pub units: &'static [f64],
    /// Returns the parameters of the effect, given the unknowns and the shape, at a joint of a Go2.
    pub values: fn(&[f64], f64) -> Vec<f64>,
    /// True if the first unknown, or its sum with what the robot's file states, cannot be negative.
    pub is_positive: bool,
    /// True if the residuals are far from linear in the only unknown, which is 1 at the end of the prior range: a list of strengths is tried.
    pub is_strength: bool,
    /// True if the first parameter is in proportion to the torque of a joint's motor: numbers are those of a Go2's.
    pub is_of_torque: bool,
    /// True if it is of the gains of the PD loop.
    pub is_gain: bool,
    /// True if each joint of a real robot has its own: a search in simulations begins with it.
    pub is_usual: bool,
    /// Values of a parameter that is no unknown.
    pub shapes: Shapes,
    /// Standard deviation of each unknown where it is too small to be reported. Empty: no robot has a little of it.
    ///
    /// Assumed: equal motors differ by a few per cent of their gains and of the torque that they have in slow motion, and delays by a
    /// fraction of a period of a field bus. What twice or half of these numbers changes in the rates was not examined.
    pub small: &'static [f64],
    /// Where every joint has a little of it.
    pub little: Presence,
    /// Adds a little to what a joint has already, if entries of the effect replace each other: unknown, and the joint's scale of torque.
    pub add: Option<fn(&mut JointModel, f64, f64)>,
}

impl LawForm {
    /// Returns a law of any sign.
    pub const fn new(place: Place, units: &'static [f64], values: fn(&[f64], f64) -> Vec<f64>) -> Self {
        Self {
            place,
            units,
            values,
            is_positive: false,
            is_strength: false,
            is_of_torque: false,
            is_gain: false,
            is_usual: false,
            shapes: Shapes::None,
            small: &[],
            little: Presence::Nowhere,
            add: None,
        }
    }

    /// Returns a law that is not negative.
    pub const fn positive(place: Place, units: &'static [f64], values: fn(&[f64], f64) -> Vec<f64>) -> Self {
        Self { is_positive: true, ..Self::new(place, units, values) }
    }

    /// Returns a law of one unknown that is 1 at the end of the prior range.
    pub const fn strength(place: Place, values: fn(&[f64], f64) -> Vec<f64>) -> Self {
        Self { is_strength: true, ..Self::positive(place, &[0.5], values) }
    }

    /// Returns the law with what every robot has a little of.
    pub const fn with_small(self, small: &'static [f64], little: Presence) -> Self {
        Self { small, little, ..self }
    }
}
