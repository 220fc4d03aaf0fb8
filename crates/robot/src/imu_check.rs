//! Compares the two readings of the direction up: accelerometer and orientation.

use std::time::Duration;

use glam::Vec3;
use twinstep_model::frames;

use crate::reading::Reading;

/// Time over which both are averaged: longer than the steps of a gait, whose accelerations cancel.
const TIME_CONSTANT: Duration = Duration::from_millis(500);
/// A smaller mean of the accelerometer has no direction: the robot falls [m/s²].
const MIN_ACCELERATION: f32 = 4.0;

/// Means of the direction up by accelerometer and by orientation, in the base frame.
///
/// The tilt of the trunk comes from the orientation alone. If its frame or the order of its entries is wrong, the
/// accelerometer disagrees as soon as the robot tilts.
#[derive(Clone, Debug, Default)]
pub(crate) struct ImuCheck {
    acc: Vec3,
    up: Vec3,
    /// Times of the first and the last reading.
    times: Option<(Duration, Duration)>,
}

impl ImuCheck {
    /// Takes in the measurements at `now`.
    pub fn add(&mut self, now: Duration, reading: &Reading) {
        let (acc, up) = (Vec3::from(reading.acc), -frames::projected_gravity(reading.orientation));
        let Some((first, last)) = self.times else {
            (self.acc, self.up, self.times) = (acc, up, Some((now, now)));
            return;
        };
        let share = (now.saturating_sub(last).as_secs_f32() / TIME_CONSTANT.as_secs_f32()).min(1.0);
        self.acc += share * (acc - self.acc);
        self.up += share * (up - self.up);
        self.times = Some((first, now));
    }

    /// Returns the angle between the two means [°]; zero as long as they have no meaning.
    pub fn degrees(&self) -> f32 {
        let is_long = self.times.is_some_and(|(first, last)| last.saturating_sub(first) >= TIME_CONSTANT);
        if !is_long || self.acc.length() < MIN_ACCELERATION {
            return 0.0;
        }
        self.acc.angle_between(self.up).to_degrees()
    }
}
