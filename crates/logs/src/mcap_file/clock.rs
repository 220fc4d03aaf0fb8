//! Times of messages by the clock of their sender.

use std::collections::VecDeque;

/// Largest relative difference between the speeds of the sender's clock and of the arrivals.
const TOLERANCE: f64 = 0.02;
/// Number of messages over which a speed is measured. Where sender or receiver stood still, it is another one.
const SPAN: usize = 100;
/// Longest time for which the receiver may stand still [ns].
const LONGEST_BURST_NS: u64 = 1_000_000_000;

/// Returns the time of each message [ns]: that of the sender's clock, shifted by the median of the delays, or the time of
/// arrival if the clock is not one.
///
/// Messages that were delayed arrive in bursts, but their sensors were read in time.
pub(crate) fn sender_times(arrivals: &[u64], clock_ns: &[u64]) -> Vec<u64> {
    if !is_clock(arrivals, clock_ns) {
        return arrivals.to_vec();
    }
    let mut delays: Vec<i128> =
        arrivals.iter().zip(clock_ns).map(|(arrival, sent)| i128::from(*arrival) - i128::from(*sent)).collect();
    delays.sort_unstable();
    let delay = delays[delays.len() / 2];
    clock_ns.iter().map(|sent| (i128::from(*sent) + delay).max(0) as u64).collect()
}

/// Returns when each message would have arrived without a delay of its own [ns]: the earliest time that the sender's clock and
/// the arrival of a later message prove; the times of arrival if the clock is not one.
///
/// Where the receiver stood still, messages arrive in a burst. The commands that were in force when they were sent are those
/// from before the burst. Unlike [`sender_times`], a pause of the sender's clock does not shift what came before or after it.
pub(crate) fn undelayed_arrivals(arrivals: &[u64], clock_ns: &[u64]) -> Vec<u64> {
    if !is_clock(arrivals, clock_ns) {
        return arrivals.to_vec();
    }
    let delay = |message: usize| i128::from(arrivals[message]) - i128::from(clock_ns[message]);
    let mut least: VecDeque<usize> = VecDeque::new();
    let mut undelayed = arrivals.to_vec();
    for message in (0..arrivals.len()).rev() {
        while least.back().is_some_and(|later| delay(*later) >= delay(message)) {
            least.pop_back();
        }
        least.push_back(message);
        while arrivals[least[0]].saturating_sub(arrivals[message]) > LONGEST_BURST_NS {
            least.pop_front();
        }
        let proved = (i128::from(clock_ns[message]) + delay(least[0])).max(0) as u64;
        undelayed[message] = undelayed.get(message + 1).map_or(proved, |later| proved.min(*later));
    }
    undelayed
}

/// Returns true if the clock increases from message to message and is, most of the time, as fast as the arrivals.
fn is_clock(arrivals: &[u64], clock_ns: &[u64]) -> bool {
    let increases = clock_ns.windows(2).all(|pair| pair[0] < pair[1]);
    increases && speed(arrivals, clock_ns).is_some_and(|speed| (speed - 1.0).abs() <= TOLERANCE)
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
    fn state_of_a_burst_would_have_arrived_before_it_and_a_pause_of_the_sender_changes_no_time() {
        let clock: Vec<u64> = (0..1000).map(|step| 7 * MS + 2 * MS * step).collect();
        let pause = |sent: &u64| if *sent > 1000 * MS { 1200 * MS } else { 500 * MS };
        let expected: Vec<u64> = clock.iter().map(|sent| sent + pause(sent)).collect();
        let mut arrivals = expected.clone();
        arrivals[100..140].fill(expected[140]);
        assert_eq!(undelayed_arrivals(&arrivals, &clock), expected);
    }

    #[test]
    fn times_do_not_decrease_where_a_long_delay_ends() {
        let clock: Vec<u64> = (0..2000).map(|step| 2 * MS * step).collect();
        let late = |sent: &u64| if *sent < 2000 * MS { 900 * MS } else { 500 * MS };
        let mut arrivals: Vec<u64> = clock.iter().map(|sent| sent + late(sent)).collect();
        let end = arrivals[1000];
        arrivals[800..1000].fill(end);
        assert!(undelayed_arrivals(&arrivals, &clock).is_sorted());
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
            assert_eq!(undelayed_arrivals(&arrivals, &clock), arrivals);
        }
        assert!(sender_times(&[], &[]).is_empty());
    }
}
