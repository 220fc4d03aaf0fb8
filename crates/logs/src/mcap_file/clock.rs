//! Times of messages by the clock of their sender.

/// Largest relative difference between the speeds of the sender's clock and of the arrivals.
const TOLERANCE: f64 = 0.02;
/// Number of messages over which a speed is measured. Where sender or receiver stood still, it is another one.
const SPAN: usize = 100;

/// Returns the time of each message [ns]: that of the sender's clock, shifted by the median of the delays, or the time of
/// arrival if the clock is not one.
///
/// Messages that were delayed arrive in bursts, but their sensors were read in time. A clock increases from message to
/// message and is, most of the time, as fast as the arrivals.
pub(crate) fn sender_times(arrivals: &[u64], clock_ns: &[u64]) -> Vec<u64> {
    let increases = clock_ns.windows(2).all(|pair| pair[0] < pair[1]);
    if !increases || speed(arrivals, clock_ns).is_none_or(|speed| (speed - 1.0).abs() > TOLERANCE) {
        return arrivals.to_vec();
    }
    let mut delays: Vec<i128> =
        arrivals.iter().zip(clock_ns).map(|(arrival, sent)| i128::from(*arrival) - i128::from(*sent)).collect();
    delays.sort_unstable();
    let delay = delays[delays.len() / 2];
    clock_ns.iter().map(|sent| (i128::from(*sent) + delay).max(0) as u64).collect()
}

/// Returns the median speed of the sender's clock, relative to the arrivals; `None` for less than two messages.
fn speed(arrivals: &[u64], clock_ns: &[u64]) -> Option<f64> {
    let span = SPAN.min(arrivals.len().saturating_sub(1));
    if span == 0 {
        return None;
    }
    let spans = |times: &[u64]| times.windows(span + 1).map(|times| times[span] as f64 - times[0] as f64).collect();
    let (arrived, sent): (Vec<f64>, Vec<f64>) = (spans(arrivals), spans(clock_ns));
    let mut speeds: Vec<f64> = arrived.iter().zip(sent).map(|(arrived, sent)| sent / arrived).collect();
    speeds.sort_unstable_by(f64::total_cmp);
    Some(speeds[speeds.len() / 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn burst_of_delayed_messages_gets_the_times_of_the_sender() {
        let clock: Vec<u64> = (0..1000).map(|step| 7 * MS + 2 * MS * step).collect();
        let mut arrivals: Vec<u64> = clock.iter().map(|sent| sent + 500 * MS).collect();
        arrivals[100..110].fill(clock[110] + 500 * MS);
        let expected: Vec<u64> = clock.iter().map(|sent| sent + 500 * MS).collect();
        assert_eq!(sender_times(&arrivals, &clock), expected);
    }

    #[test]
    fn pause_of_the_sender_does_not_make_its_clock_useless() {
        let clock: Vec<u64> = (0..1000).map(|step| 2 * MS * step).collect();
        let arrivals: Vec<u64> = clock.iter().map(|sent| sent + if *sent > 1900 * MS { 700 * MS } else { 0 }).collect();
        assert_eq!(sender_times(&arrivals, &clock), clock);
    }

    #[test]
    fn counter_that_is_not_a_clock_is_not_used() {
        let arrivals: Vec<u64> = (0..1000).map(|step| 2 * MS * step).collect();
        let microseconds: Vec<u64> = (0..1000).map(|step| 2 * step).collect();
        let standing = vec![5; 1000];
        for clock in [microseconds, standing] {
            assert_eq!(sender_times(&arrivals, &clock), arrivals);
        }
        assert!(sender_times(&[], &[]).is_empty());
    }
}
