//! Error of a setting that is outside its range.

/// A setting is outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`sim.{field}` = {value} is not allowed: {allowed}")]
pub struct SimConfigError {
    /// The key.
    pub field: &'static str,
    /// Its value.
    pub value: String,
    /// The allowed values.
    pub allowed: String,
}

/// Checks that `value` is within the range `[low, high]`.
pub(crate) fn in_range(
    field: &'static str,
    value: f32,
    [low, high]: [f32; 2],
    allowed: impl Fn() -> String,
) -> Result<(), SimConfigError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(SimConfigError { field, value: value.to_string(), allowed: allowed() })
}
