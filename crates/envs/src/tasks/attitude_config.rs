//! Settings of the task `attitude`.

use serde::{Deserialize, Serialize};

use super::walk_config::WalkConfig;
use crate::config::{ConfigError, Range, check_range, check_value};

/// The `[task]` table of `attitude`: the reference, the weights of its two terms, and what it has in common with `walk`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AttitudeConfig {
    /// Largest amplitude of the roll angle [rad].
    pub roll_rad: f32,
    /// Largest amplitude of the pitch angle [rad].
    pub pitch_rad: f32,
    /// Largest amplitude of the height of the base about `walk.target_base_height_m` [m].
    pub height_m: f32,
    /// Range of the frequencies of the reference [Hz].
    pub frequency_hz: Range,
    /// Weight of `exp(−(roll error² + pitch error²) / attitude_sigma)`, per second.
    pub track_attitude: f32,
    /// Weight of `exp(−height error² / height_sigma)`, per second.
    pub track_height: f32,
    /// Width σ of the term `track_attitude` [rad²].
    pub attitude_sigma: f32,
    /// Width σ of the term `track_height` [m²].
    pub height_sigma: f32,
    /// Rewards and ends of `walk`, whose velocity command is zero.
    pub walk: WalkConfig,
}

impl Default for AttitudeConfig {
    fn default() -> Self {
        Self {
            roll_rad: 0.3,
            pitch_rad: 0.25,
            height_m: 0.03,
            frequency_hz: [0.1, 0.5],
            track_attitude: 4.0,
            track_height: 1.0,
            attitude_sigma: 0.01,
            height_sigma: 0.0004,
            walk: WalkConfig::default(),
        }
    }
}

impl AttitudeConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_value("task.roll_rad", self.roll_rad, 0.0, 1.0)?;
        check_value("task.pitch_rad", self.pitch_rad, 0.0, 1.0)?;
        check_value("task.height_m", self.height_m, 0.0, 0.2)?;
        check_range("task.frequency_hz", self.frequency_hz, 0.0, 5.0)?;
        check_value("task.track_attitude", self.track_attitude, -1e6, 1e6)?;
        check_value("task.track_height", self.track_height, -1e6, 1e6)?;
        check_value("task.attitude_sigma", self.attitude_sigma, 1e-6, 1e6)?;
        check_value("task.height_sigma", self.height_sigma, 1e-6, 1e6)?;
        self.walk.check_as_part().map_err(|error| error.within("walk"))
    }
}
