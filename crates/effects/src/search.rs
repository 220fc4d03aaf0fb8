//! How an effect is fitted and seen, and how the blind test hides it.

/// How an effect is fitted in simulations.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    /// Step of the differences that approximate derivatives of a fit, on either side [prior std].
    ///
    /// A small one has the derivatives of contact events where a robot walks: with 0.02 the fit of a payload stops at half of
    /// its distance from the trunk's centre.
    pub derivative_step: f64,
    /// False if the effect depends on supply voltage or temperature, which are not known for another motion.
    pub predictable: bool,
}

impl Search {
    /// Most effects.
    pub const DEFAULT: Self = Self { derivative_step: 0.1, predictable: true };
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
