//! Why a command is not sent.

use twinstep_model::Joint;

/// A number of a command is outside its limits, or not finite.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("`{quantity}` of {joint} is {value}, outside {low} to {high}")]
pub struct UnsafeCommand {
    /// Joint.
    pub joint: Joint,
    /// Field of the command.
    pub quantity: &'static str,
    /// Value of the field.
    pub value: f32,
    /// Lowest allowed value.
    pub low: f32,
    /// Highest allowed value.
    pub high: f32,
}
