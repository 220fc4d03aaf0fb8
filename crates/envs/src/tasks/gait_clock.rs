//! Commanded gait: phase of each foot, contact schedule and height of swinging feet.

use std::f32::consts::TAU;

use serde::{Deserialize, Serialize};
use twinstep_model::PerLeg;

/// Order in which the feet touch the ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gait {
    /// Diagonal pairs of feet alternate.
    Trot,
    /// The left and the right feet alternate.
    Pace,
    /// The front and the hind feet alternate.
    Bound,
    /// All feet touch the ground together.
    Pronk,
}

impl Gait {
    /// All gaits.
    pub const ALL: [Self; 4] = [Self::Trot, Self::Pace, Self::Bound, Self::Pronk];

    /// Returns the name in config files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Trot => "trot",
            Self::Pace => "pace",
            Self::Bound => "bound",
            Self::Pronk => "pronk",
        }
    }

    /// Returns the phases of FR, RL and RR relative to FL [cycles].
    pub const fn phase_offset(self) -> [f32; 3] {
        match self {
            Self::Trot => [0.5, 0.5, 0.0],
            Self::Pace => [0.5, 0.0, 0.5],
            Self::Bound => [0.0, 0.5, 0.5],
            Self::Pronk => [0.0, 0.0, 0.0],
        }
    }
}

/// Clock of a commanded gait. A foot is to be on the ground from phase 0 to the duty factor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GaitClock {
    /// Phase of FL [cycles], from 0 to 1.
    pub phase: f32,
    /// Cycles per second [Hz].
    pub step_frequency: f32,
    /// Phases of FR, RL and RR relative to FL [cycles].
    pub phase_offset: [f32; 3],
}

impl GaitClock {
    /// Advances the clock by `dt` [s].
    pub fn advance(&mut self, dt: f32) {
        self.phase = (self.phase + self.step_frequency * dt).fract();
    }

    /// Returns the phases of FL, FR, RL and RR [cycles], from 0 to 1.
    pub fn foot_phases(&self) -> PerLeg {
        let [fr, rl, rr] = self.phase_offset;
        [0.0, fr, rl, rr].map(|offset| (self.phase + offset).fract())
    }

    /// Returns sine, then cosine, of the phase angle of each foot.
    pub fn sin_cos(&self) -> [f32; 8] {
        let angles = self.foot_phases().map(|phase| (TAU * phase).sin_cos());
        std::array::from_fn(|entry| if entry < 4 { angles[entry].0 } else { angles[entry - 4].1 })
    }
}

/// Contact schedule of a foot as a function of its phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSchedule {
    /// Share of a cycle in which the foot is to be on the ground.
    pub duty_factor: f32,
    /// Standard deviation of the transitions [cycles].
    pub transition_std: f32,
}

impl ContactSchedule {
    /// Returns the probability with which a foot is to be on the ground (Walk These Ways, contact schedule).
    pub fn desired_contact(&self, phase: f32) -> f32 {
        let cdf = |x: f32| logistic_cdf(x / self.transition_std);
        let stance = |phase: f32| cdf(phase) * (1.0 - cdf(phase - self.duty_factor));
        stance(phase) + stance(phase - 1.0)
    }

    /// Returns the height of the sole in units of the highest one: a triangle over the swing phase, 0 in the stance.
    pub fn swing_height(&self, phase: f32) -> f32 {
        let progress = (phase - self.duty_factor) / (1.0 - self.duty_factor);
        (1.0 - (2.0 * progress - 1.0).abs()).max(0.0)
    }
}

/// Logistic approximation of the standard normal distribution function. Its largest error is 0.01.
fn logistic_cdf(x: f32) -> f32 {
    1.0 / (1.0 + (-1.702 * x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCHEDULE: ContactSchedule = ContactSchedule { duty_factor: 0.5, transition_std: 0.07 };

    /// Returns which feet are to be on the ground at a phase of FL.
    fn stance(gait: Gait, phase: f32) -> [bool; 4] {
        let clock = GaitClock { phase, step_frequency: 2.0, phase_offset: gait.phase_offset() };
        clock.foot_phases().map(|phase| SCHEDULE.desired_contact(phase) > 0.5)
    }

    #[test]
    fn gaits_have_the_pairs_of_feet_of_their_names() {
        // FL, FR, RL, RR.
        assert_eq!(stance(Gait::Trot, 0.25), [true, false, false, true]);
        assert_eq!(stance(Gait::Pace, 0.25), [true, false, true, false]);
        assert_eq!(stance(Gait::Bound, 0.25), [true, true, false, false]);
        assert_eq!(stance(Gait::Pronk, 0.25), [true; 4]);
        for gait in Gait::ALL {
            assert_eq!(stance(gait, 0.75), stance(gait, 0.25).map(|on_ground| !on_ground), "{}", gait.name());
        }
    }

    #[test]
    fn schedule_is_periodic_and_has_the_duty_factor() {
        let phases = || (0..1000).map(|step| step as f32 / 1000.0);
        let schedule = ContactSchedule { duty_factor: 0.6, transition_std: 0.05 };
        let mean = phases().map(|phase| schedule.desired_contact(phase)).sum::<f32>() / 1000.0;
        assert!((mean - 0.6).abs() < 2e-3, "{mean}");
        assert!((schedule.desired_contact(0.0) - schedule.desired_contact(0.9999)).abs() < 5e-3);
        assert!(phases().all(|phase| (0.0..=1.0).contains(&schedule.desired_contact(phase))));
        assert!(schedule.desired_contact(0.3) > 0.99 && schedule.desired_contact(0.8) < 0.03);
    }

    #[test]
    fn sole_is_highest_in_the_middle_of_the_swing_phase() {
        assert_eq!([0.0, 0.25, 0.5, 0.625, 0.75].map(|phase| SCHEDULE.swing_height(phase)), [0.0, 0.0, 0.0, 0.5, 1.0]);
    }

    #[test]
    fn clock_has_the_step_frequency() {
        let mut clock = GaitClock { phase: 0.9, step_frequency: 2.5, phase_offset: Gait::Trot.phase_offset() };
        (0..100).for_each(|_| clock.advance(0.02));
        // 2 s are 5 cycles.
        assert!((clock.phase - 0.9).abs() < 1e-4, "{clock:?}");
        let [sin, cos] = [clock.sin_cos()[1], clock.sin_cos()[5]];
        let angle = TAU * 0.4;
        assert!((sin - angle.sin()).abs() < 1e-3 && (cos - angle.cos()).abs() < 1e-3, "phase of FR");
    }
}
