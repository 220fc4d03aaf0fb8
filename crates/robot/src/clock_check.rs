//! Compares the robot's clock with this computer's.

use std::time::Duration;

/// Time after which the rate of the robot's clock is known.
const LEARNING: Duration = Duration::from_millis(500);
/// Time by which a state may be ahead of those before it: they waited in queues.
const MAX_LEAD: f64 = 0.1;
/// Largest error of the measured rate, as a share of it.
const RATE_ERROR: f64 = 0.01;

/// The robot's clock, in the time of this computer. The vendor does not document its unit, so it is measured.
#[derive(Clone, Debug, Default)]
pub(crate) struct ClockCheck {
    /// Arrival of the first and of the last state.
    arrivals: Option<(Duration, Duration)>,
    last_tick: u32,
    /// Ticks since the first state.
    ticks: i64,
    /// Ticks per second; `None` until it is known.
    rate: Option<f64>,
    /// Largest lead of the robot's clock so far: time since the first state by its ticks, less that by arrival [s].
    lead: f64,
}

impl ClockCheck {
    /// Takes in the tick of a state that arrived at `now`. Returns the change of the clock [ticks] if it is not that of time.
    pub fn add(&mut self, now: Duration, tick: u32) -> Option<i64> {
        let Some((first, last)) = self.arrivals else {
            *self = Self { arrivals: Some((now, now)), last_tick: tick, ..Self::default() };
            return None;
        };
        let change = i64::from(tick.wrapping_sub(self.last_tick) as i32);
        (self.arrivals, self.last_tick) = (Some((first, now)), tick);
        self.ticks += change;
        let elapsed = now.saturating_sub(first).as_secs_f64();
        if self.rate.is_none() && elapsed >= LEARNING.as_secs_f64() && self.ticks > 0 {
            self.rate = Some(self.ticks as f64 / elapsed);
        }
        let lead = self.rate.map_or(0.0, |rate| self.ticks as f64 / rate - elapsed);
        // Messages may be reordered on the way.
        let goes_back = self.rate.is_some_and(|rate| (change as f64) < -rate * MAX_LEAD);
        if goes_back || lead > self.lead + MAX_LEAD {
            self.arrivals = None;
            return Some(change);
        }
        let forgotten = RATE_ERROR * now.saturating_sub(last).as_secs_f64();
        self.lead = lead.max(self.lead - forgotten);
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a check that has seen a second of a clock with `ticks_per_ms`, from `start`.
    fn after_a_second(ticks_per_ms: u32, start: u32) -> ClockCheck {
        let mut check = ClockCheck::default();
        for ms in (0..=1000).step_by(2) {
            let tick = start.wrapping_add(ms * ticks_per_ms);
            assert_eq!(check.add(Duration::from_millis(ms.into()), tick), None);
        }
        check
    }

    #[test]
    fn clock_in_any_unit_is_followed_also_over_its_end_and_over_a_pause() {
        for (ticks_per_ms, start) in [(1, 0), (1000, 7), (1, u32::MAX - 500)] {
            let mut check = after_a_second(ticks_per_ms, start);
            let at = |ms: u32| start.wrapping_add(ms * ticks_per_ms);
            assert_eq!(check.add(Duration::from_millis(1300), at(1002)), None, "it waited in a queue");
            assert_eq!(check.add(Duration::from_millis(1300), at(1090)), None);
            assert_eq!(check.add(Duration::from_millis(1700), at(1690)), None);
        }
    }

    #[test]
    fn clock_that_goes_back_or_ahead_of_time_jumps() {
        let mut check = after_a_second(1, 0);
        assert_eq!(check.add(Duration::from_millis(1002), 998), None, "a message was reordered");
        assert_eq!(check.add(Duration::from_millis(1004), 3), Some(-995), "the robot was switched off and on");
        let mut check = after_a_second(1, 0);
        assert_eq!(check.add(Duration::from_millis(1002), 60_000), Some(59_000), "states of another time");
    }
}
