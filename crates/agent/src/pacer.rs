//! Periods in real time.

use std::time::{Duration, Instant};

/// Waits for the beginning of each period.
pub struct Pacer {
    period: Duration,
    next: Instant,
}

impl Pacer {
    /// Creates a pacer whose first period begins now.
    pub fn new(period: Duration) -> Self {
        Self { period, next: Instant::now() }
    }

    /// Waits until the next period begins. Returns how late the call is.
    ///
    /// After a delay of more than a period, the periods begin at the next step: no burst of steps follows.
    pub fn wait(&mut self) -> Duration {
        let now = Instant::now();
        let late = now.saturating_duration_since(self.next);
        std::thread::sleep(self.next.saturating_duration_since(now));
        self.next = if late > self.period { now } else { self.next } + self.period;
        late
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_have_their_length_on_average_and_a_delay_is_not_caught_up() {
        let period = Duration::from_millis(5);
        let (mut pacer, start) = (Pacer::new(period), Instant::now());
        for _ in 0..21 {
            pacer.wait();
        }
        assert!(start.elapsed() >= 20 * period);
        std::thread::sleep(10 * period);
        assert!(pacer.wait() >= 8 * period);
        let after = Instant::now();
        pacer.wait();
        pacer.wait();
        assert!(after.elapsed() >= period, "the missed periods were not caught up");
    }
}
