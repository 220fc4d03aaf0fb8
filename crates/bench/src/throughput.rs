//! Throughput: rate and latency of a repeated function, over windows.

use std::time::{Duration, Instant};

use crate::error::BenchError;

/// Number of windows, of which the median is reported.
pub const WINDOWS: usize = 5;

/// Result of one window.
#[derive(Clone, Copy)]
pub struct Throughput {
    /// Calls per second.
    pub per_second: f64,
    /// Median time of one call [µs].
    pub median_us: f64,
}

/// Calls `once` repeatedly for `window_s` seconds.
pub fn measure(window_s: f64, mut once: impl FnMut() -> Result<(), BenchError>) -> Result<Throughput, BenchError> {
    let (window, since) = (Duration::from_secs_f64(window_s), Instant::now());
    let mut times = Vec::new();
    let mut last = since;
    while last.duration_since(since) < window {
        once()?;
        let now = Instant::now();
        times.push(now.duration_since(last));
        last = now;
    }
    let per_second = times.len() as f64 / last.duration_since(since).as_secs_f64();
    times.sort_unstable();
    Ok(Throughput { per_second, median_us: times[times.len() / 2].as_secs_f64() * 1e6 })
}

/// Returns the median of several windows, for each number separately.
pub fn median(paces: &[Throughput]) -> Throughput {
    let middle = |pick: fn(&Throughput) -> f64| median_of(paces.iter().map(pick).collect());
    Throughput { per_second: middle(|pace| pace.per_second), median_us: middle(|pace| pace.median_us) }
}

/// Returns the median; the upper one of the middle two for an even count.
pub fn median_of(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
