//! How diagnosis searches for an effect, and how the blind test hides it.

/// Sizes of probes, relative to the distance from no effect to the end of the prior range.
const SHARES: [f64; 5] = [0.1, 0.2, 0.4, 0.75, 1.3];

/// How diagnosis searches for an effect.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    /// Values that are tried first, on rows with a fixed base, in which the joints are nearly decoupled.
    pub probes: Probes,
    /// Values that are tried first on the whole log, if it has rows with a floating base.
    pub whole_log_probes: Probes,
    /// True if the loop may oscillate: probes close to each other are then needed to stay in phase.
    pub oscillates: bool,
    /// Returns values close to a probe, the best of which the fit starts from; none for effects without many local minima.
    pub near: fn(&[f64]) -> Vec<Vec<f64>>,
    /// Step of the differences that approximate derivatives of a fit, on either side [prior std].
    ///
    /// A small one has the derivatives of contact events where a robot walks: with 0.02 the fit of a payload stops at half of
    /// its distance from the trunk's centre.
    pub derivative_step: f64,
    /// Minimum size of a reported cause, relative to the prior range.
    pub min_share: f64,
    /// False if the effect depends on supply voltage or temperature, which are not known for another motion.
    pub predictable: bool,
}

impl Search {
    /// Most effects: probes of the first parameter over its prior range.
    pub const DEFAULT: Self = Self {
        probes: Probes::FirstParameter(&[&[]]),
        whole_log_probes: Probes::None,
        oscillates: false,
        near: |_| Vec::new(),
        derivative_step: 0.1,
        min_share: 0.1,
        predictable: true,
    };
}

/// Values of an effect that are tried first.
#[derive(Clone, Copy, Debug)]
pub enum Probes {
    /// Values of the first parameter over its prior range, each with all of these values of the other parameters.
    FirstParameter(&'static [&'static [f64]]),
    /// These values of all parameters.
    Values(fn() -> Vec<Vec<f64>>),
    /// None: the effect is not visible in these rows, or diagnosis does not test it.
    None,
}

/// Residual in which an effect is visible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Visibility {
    /// The torque that a motor-current sensor measures.
    MotorTorque,
    /// The torque at the output of the joint, behind the motor-current sensor.
    OutputTorque,
    /// The torque on the link, which no sensor measures: the inverse-dynamics residual.
    LinkTorque,
    /// Positions only.
    Position,
}

/// Variable of a log that explains the residual of an effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variable {
    /// Joint position.
    Position,
    /// Joint velocity.
    Velocity,
    /// Joint acceleration.
    Acceleration,
    /// Torque of an actuator without effects.
    CommandedTorque,
    /// Rate of that torque.
    CommandedTorqueRate,
    /// Rate of the commanded position.
    CommandRate,
    /// Magnitude of the torque of an actuator without effects, with the sign of the velocity.
    Load,
    /// Supply voltage.
    Voltage,
    /// Motor temperature.
    Temperature,
    /// Time.
    Time,
}

/// What a log of the blind test must contain for an effect to be visible in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BlindTestCondition {
    /// Legs in the air: fast motion, slow motion and steps.
    FixedBase,
    /// Feet on the ground.
    FloatingBase,
    /// A torque sensor.
    Torque,
    /// The supply voltage.
    Voltage,
    /// The motor temperatures.
    Temperature,
}

/// Returns probes of a parameter, from small to large, on both sides of `no_effect_value` where `range` has both.
///
/// With an infinite `no_effect_value`, the size of an effect is its inverse.
pub fn probes_over([low, high]: [f64; 2], no_effect_value: f64) -> Vec<f64> {
    let at = |share: f64, end: f64| no_effect_value + share * (end - no_effect_value);
    if no_effect_value.is_infinite() {
        return SHARES.map(|share| low / share).to_vec();
    }
    let ends = [low, high].into_iter().filter(|end| (end - no_effect_value).abs() > 1e-9);
    SHARES.into_iter().flat_map(|share| ends.clone().map(move |end| at(share, end))).collect()
}

/// Returns vectors along each of three axes, up to half of `end`.
pub fn probes_along_axes(end: f64) -> Vec<Vec<f64>> {
    let along = |axis: usize| {
        [-0.5, -0.15, 0.15, 0.5]
            .map(|share| (0..3).map(|one| if one == axis { share * end } else { 0.0 }).collect::<Vec<_>>())
    };
    (0..3).flat_map(along).collect()
}
