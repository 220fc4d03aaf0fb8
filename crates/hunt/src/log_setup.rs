//! Base mounting, channels and length of the log of a case.

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use twinstep_effects::{BlindTestCondition, CATALOGUE, Effect};
use twinstep_model::stream;

use crate::base_schedule::{BaseSchedule, LogLength};
use crate::mismatch::Mismatch;
use crate::{Plant, Suite};

/// Base mounting and channels of a case's log; independent of the hidden effects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::struct_excessive_bools, reason = "each is a group of channels, any of which may be missing")]
pub struct LogSetup {
    /// Mounting of the base.
    pub place: BaseSchedule,
    /// True if the motor currents are measured.
    pub torque: bool,
    /// True if the supply voltage is measured.
    pub battery: bool,
    /// True if the motor temperatures are measured.
    pub temperature: bool,
    /// True if position and velocity of a floating base are measured.
    #[serde(default = "measured")]
    pub motion_capture: bool,
    /// Length of the log.
    #[serde(default)]
    pub length: LogLength,
}

fn measured() -> bool {
    true
}

impl LogSetup {
    /// Returns base mounting, channels and length of the log of a case.
    pub fn draw(seed: u64, number: u64, plant: Plant, suite: Suite) -> Self {
        let drawn = Self::drawn(&mut stream(seed, "hunt setting", number));
        match suite {
            Suite::Mixed | Suite::Unmodelled if plant == Plant::Mujoco => {
                Self { place: BaseSchedule::Whole, torque: true, ..drawn }
            }
            Suite::Mixed | Suite::Unmodelled => drawn,
            Suite::Healthy => {
                // Of nine robots of each family, six have logs of a minute, two of 10 s and one of five minutes.
                let round = (number / Mismatch::ALL.len() as u64) % 9;
                let length = match round {
                    1 | 6 => LogLength::TenSeconds,
                    4 => LogLength::FiveMinutes,
                    _ => LogLength::Standard,
                };
                Self { place: BaseSchedule::Whole, torque: true, length, ..drawn }
            }
            Suite::Walking => Self { place: BaseSchedule::Walking, motion_capture: false, ..drawn },
            Suite::Confusable => {
                Self { place: BaseSchedule::Fixed, torque: false, battery: false, temperature: false, ..drawn }
            }
        }
    }

    /// Samples base mounting and channels of a log in rapier.
    fn drawn(random: &mut impl Rng) -> Self {
        let place = match random.random_range(0.0..1.0) {
            share if share < 0.35 => BaseSchedule::Fixed,
            share if share < 0.45 => BaseSchedule::Floating,
            _ => BaseSchedule::FixedThenFloating,
        };
        Self {
            place,
            torque: random.random_bool(0.7),
            battery: random.random_bool(0.5),
            temperature: random.random_bool(0.5),
            motion_capture: true,
            length: LogLength::Standard,
        }
    }

    /// Returns the setup of a log with motor currents.
    #[cfg(test)]
    pub fn with_torque(place: BaseSchedule) -> Self {
        let length = LogLength::Standard;
        Self { place, torque: true, battery: false, temperature: false, motion_capture: true, length }
    }

    fn has(self, condition: BlindTestCondition) -> bool {
        match condition {
            BlindTestCondition::FixedBase => self.place != BaseSchedule::Floating,
            BlindTestCondition::FloatingBase => self.place != BaseSchedule::Fixed,
            BlindTestCondition::Torque => self.torque,
            BlindTestCondition::Voltage => self.battery,
            BlindTestCondition::Temperature => self.temperature,
        }
    }

    /// Returns the effects that the blind test hides in such a log.
    pub fn visible_effects(self) -> Vec<&'static Effect> {
        let is_visible = |effect: &&Effect| {
            effect.blind_test.is_some_and(|conditions| conditions.iter().all(|condition| self.has(*condition)))
        };
        CATALOGUE.into_iter().filter(is_visible).collect()
    }
}
