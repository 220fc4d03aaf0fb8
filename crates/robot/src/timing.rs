//! How punctual the control loop is.

use std::time::Duration;

/// Width of a bin of a histogram [ns].
const BIN_NS: u64 = 10_000;
/// Number of bins; the last one has everything above.
const BINS: usize = 2000;

/// Times of the loop since its start.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timing {
    /// Number of steps.
    pub steps: u64,
    /// Number of states that could not be used.
    pub bad_states: u64,
    /// Number of messages that the recorder had no room for.
    pub unrecorded: u64,
    /// Time between two commands while armed.
    pub gaps: Histogram,
    /// How much longer than the period of 2 ms it was since the step before.
    pub lateness: Histogram,
    /// How long after it was due the timer woke the loop: only the steps before which no state arrived in time.
    pub timer_lateness: Histogram,
    /// Time from the arrival of a state to the sending of its command.
    pub latency: Histogram,
    /// Deviation of the time between two ticks from the policy period.
    pub tick_jitter: Histogram,
}

/// Distribution of times, in bins of 10 µs up to 20 ms.
#[derive(Clone, Debug, PartialEq)]
pub struct Histogram {
    bins: Vec<u32>,
    count: u64,
    max: Duration,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: vec![0; BINS], count: 0, max: Duration::ZERO }
    }
}

impl Histogram {
    /// Adds a time.
    pub fn add(&mut self, time: Duration) {
        let bin = (time.as_nanos() as u64 / BIN_NS).min(BINS as u64 - 1);
        self.bins[bin as usize] += 1;
        self.count += 1;
        self.max = self.max.max(time);
    }

    /// Returns the time that `share` (0 to 1) of all times do not exceed, rounded up to a bin. Zero without times.
    pub fn quantile(&self, share: f64) -> Duration {
        let wanted = (share * self.count as f64).ceil() as u64;
        let mut seen = 0;
        for (bin, count) in self.bins.iter().enumerate() {
            seen += u64::from(*count);
            if seen >= wanted && seen > 0 {
                return Duration::from_nanos((bin as u64 + 1) * BIN_NS).min(self.max);
            }
        }
        self.max
    }

    /// Returns the largest time.
    pub fn max(&self) -> Duration {
        self.max
    }

    /// Returns the number of times above `limit`, which is at most 20 ms; to a bin.
    pub fn count_above(&self, limit: Duration) -> u64 {
        let first = (limit.as_nanos() as u64).div_ceil(BIN_NS) as usize;
        self.bins.iter().skip(first).map(|count| u64::from(*count)).sum()
    }

    /// Returns the number of times.
    pub fn count(&self) -> u64 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_times() {
        let mut histogram = Histogram::default();
        (1..=1000).for_each(|step| histogram.add(Duration::from_micros(step)));
        for (share, micros) in [(0.5, 500), (0.99, 990), (1.0, 1000)] {
            let found = histogram.quantile(share).as_micros();
            assert!(found.abs_diff(micros) <= 10, "{share}: {found}");
        }
        assert_eq!((histogram.count(), histogram.max()), (1000, Duration::from_millis(1)));
        assert_eq!(histogram.count_above(Duration::from_micros(900)), 101, "900 µs is the first of its bin");
        histogram.add(Duration::from_secs(1));
        assert_eq!(histogram.count_above(Duration::from_millis(10)), 1);
        let histogram = Histogram::default();
        assert_eq!(histogram.quantile(0.5), Duration::ZERO);
    }
}
