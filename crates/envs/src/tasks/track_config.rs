//! Settings of the task `track`.

use serde::{Deserialize, Serialize};

use super::walk_config::WalkConfig;
use crate::config::{ConfigError, check_value};
use crate::path::PathShape;

/// The `[task]` table of `track`: the path, the weights of its two terms, and what it has in common with `walk`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackConfig {
    /// Shape of the path.
    pub path: PathShape,
    /// Radius of circles; half the side of the square [m].
    pub radius_m: f32,
    /// Speed on circles and sides [m/s].
    pub speed: f32,
    /// Maximum distance of the start of a random path from the robot [m].
    pub start_offset_m: f32,
    /// Maximum angle between the start of a random path and the robot [rad].
    pub start_offset_rad: f32,
    /// Rate at which the velocity of the tracking rewards removes an error of the pose [1/s].
    pub correction_rate: f32,
    /// Weight of `exp(−|position error|² / position_sigma)`, per second.
    pub track_position: f32,
    /// Weight of `exp(−heading error² / heading_sigma)`, per second.
    pub track_heading: f32,
    /// Width σ of the term `track_position` [m²].
    pub position_sigma: f32,
    /// Width σ of the term `track_heading` [rad²].
    pub heading_sigma: f32,
    /// Position error above which the episode terminates [m].
    pub max_position_error_m: f32,
    /// False: the pose error of the observation is zero, as without motion capture.
    pub observe_pose_error: bool,
    /// Rewards and ends of `walk`; the ranges of its commands are those of random paths.
    pub walk: WalkConfig,
}

impl Default for TrackConfig {
    fn default() -> Self {
        Self {
            path: PathShape::Random,
            radius_m: 1.0,
            speed: 0.5,
            start_offset_m: 0.2,
            start_offset_rad: 0.3,
            correction_rate: 1.0,
            track_position: 2.0,
            track_heading: 1.0,
            position_sigma: 0.04,
            heading_sigma: 0.05,
            max_position_error_m: 1.0,
            observe_pose_error: true,
            walk: WalkConfig::default(),
        }
    }
}

impl TrackConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_value("task.radius_m", self.radius_m, 0.1, 100.0)?;
        check_value("task.speed", self.speed, 0.05, 5.0)?;
        check_value("task.start_offset_m", self.start_offset_m, 0.0, 10.0)?;
        check_value("task.start_offset_rad", self.start_offset_rad, 0.0, 3.2)?;
        check_value("task.correction_rate", self.correction_rate, 0.0, 50.0)?;
        check_value("task.track_position", self.track_position, -1e6, 1e6)?;
        check_value("task.track_heading", self.track_heading, -1e6, 1e6)?;
        check_value("task.position_sigma", self.position_sigma, 1e-6, 1e6)?;
        check_value("task.heading_sigma", self.heading_sigma, 1e-6, 1e6)?;
        check_value("task.max_position_error_m", self.max_position_error_m, 0.01, 1e6)?;
        self.walk.check_as_part().map_err(|error| error.within("walk"))
    }
}
