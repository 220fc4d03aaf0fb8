//! Checks of settings, whose errors name the key, its value and what is allowed.

/// Fails if a value is outside its range.
pub fn within(name: &str, value: f64, low: f64, high: f64) -> Result<(), String> {
    if (low..=high).contains(&value) { Ok(()) } else { Err(format!("`{name}` = {value} is outside {low} to {high}")) }
}

/// Fails unless a duration consists of whole segments [s].
pub fn whole_segments(seconds: f64, segment_s: f64) -> Result<(), String> {
    let segments = seconds / segment_s;
    if (segments - segments.round()).abs() <= 1e-6 {
        return Ok(());
    }
    Err(format!("`seconds` = {seconds} is not a multiple of `segment_s` = {segment_s}"))
}
