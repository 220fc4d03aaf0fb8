//! Times at which messages were sent, on the clock of the recorder.
//!
//! A message arrives late, never early: of all messages within a short time, the least delayed one shows how far the clock of
//! the sender is from that of the recorder. So the time of a message is that of its sender's clock plus the smallest delay
//! around it. That holds for bursts and jitter. Commands have no clock; their sender sends them at a fixed period, so that
//! their number is one.

/// Largest difference between the speeds of two clocks, relative.
const MAX_DRIFT: f64 = 200e-6;
/// Change of the delay from one message to the next that a network does not make, unless it stood still [ns].
const MAX_DELAY_NS: i128 = 250_000_000;
/// Time after which a network that stood still delivers in time again [ns].
const STALL_NS: u64 = 2_000_000_000;
/// Most messages that are looked at after a network stood still.
const MAX_STALLED: usize = 5000;
/// Largest relative difference between the speeds of the sender's clock and of the arrivals.
const TOLERANCE: f64 = 0.02;
/// Number of messages over which a speed is measured. Where sender or receiver stood still, it is another one.
const SPAN: usize = 100;
/// Number of messages that must follow a restart of the clock before it counts as one.
const AFTER_RESTART: usize = 5;
/// Number of parts of a recording in each of which a message must be in time.
const MAX_PARTS: usize = 50;
/// Largest share of messages without a usable time. With more the clock is none.
const MAX_UNUSABLE: f64 = 0.1;

/// Times of messages, and what was found about the clock.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct SendTimes {
    /// Time of each message [ns]; `None` for one whose clock has a wrong value.
    pub times: Vec<Option<u64>>,
    /// Messages from which on the clock has started again.
    pub restarts: Vec<usize>,
    /// True if the sender's clock was used; false if the times are those of arrival.
    pub is_by_clock: bool,
}

impl SendTimes {
    /// Returns the times of arrival.
    pub fn of_arrivals(arrivals: &[u64]) -> Self {
        let times = arrivals.iter().map(|time| Some(*time)).collect();
        Self { times, restarts: Vec::new(), is_by_clock: false }
    }
}

/// Returns the times of messages by the clock of their sender, in the order of arrival; those of arrival if it is no clock.
pub(crate) fn sender_times(arrivals: &[u64], clock_ns: &[u64]) -> SendTimes {
    let delays: Vec<i128> =
        arrivals.iter().zip(clock_ns).map(|(at, sent)| i128::from(*at) - i128::from(*sent)).collect();
    let Some((parts, unusable)) = runs(clock_ns, &delays) else { return SendTimes::of_arrivals(arrivals) };
    let mut result = SendTimes { times: vec![None; arrivals.len()], restarts: Vec::new(), is_by_clock: true };
    for (index, part) in parts.iter().enumerate() {
        if index > 0 {
            result.restarts.push(part[0]);
        }
        let clock: Vec<i128> = part.iter().map(|message| i128::from(clock_ns[*message])).collect();
        let own: Vec<i128> = part.iter().map(|message| delays[*message]).collect();
        for ((message, sent), delay) in part.iter().zip(&clock).zip(smallest_delays(&clock, &own)) {
            result.times[*message] = Some((sent + delay).max(0) as u64);
        }
    }
    let used: Vec<usize> = parts.concat();
    let pick = |times: &[u64]| used.iter().map(|message| times[*message]).collect::<Vec<_>>();
    let is_fast_enough = speed(&pick(arrivals), &pick(clock_ns)).is_some_and(|speed| (speed - 1.0).abs() <= TOLERANCE);
    if unusable as f64 > MAX_UNUSABLE * arrivals.len() as f64 || !is_fast_enough {
        return SendTimes::of_arrivals(arrivals);
    }
    result
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

/// Returns the messages of each run of the clock, and the number of those in none. `None` if the clock does not run.
///
/// In a run the clock increases as the messages arrive. A message that does not fit is wrong, or the first one after a
/// restart, if those that follow fit it. A network that stood still delivers what it kept, and is in time again later.
fn runs(clock_ns: &[u64], delays: &[i128]) -> Option<(Vec<Vec<usize>>, usize)> {
    let later = |message: usize| {
        let end = clock_ns[message].saturating_add(STALL_NS);
        (message..clock_ns.len())
            .take(MAX_STALLED)
            .take_while(move |next| clock_ns[*next] <= end)
            .map(|next| delays[next])
            .min()
    };
    let fits = |before: usize, after: usize| {
        let change = delays[after] - delays[before];
        let is_stall = || later(after).is_some_and(|least| least - delays[before] <= MAX_DELAY_NS / 2);
        clock_ns[after] > clock_ns[before] && (change.abs() <= MAX_DELAY_NS || (change > 0 && is_stall()))
    };
    let (mut parts, mut unusable): (Vec<Vec<usize>>, usize) = (Vec::new(), 0);
    for message in 0..clock_ns.len() {
        let last = parts.last().and_then(|part| part.last().copied());
        let following = message + 1..(message + 1 + AFTER_RESTART).min(clock_ns.len());
        let is_followed = following.len() == AFTER_RESTART && following.clone().all(|next| fits(next - 1, next));
        match last {
            Some(last) if fits(last, message) => parts.last_mut()?.push(message),
            Some(last) if following.clone().next().is_some_and(|next| fits(last, next)) => unusable += 1,
            _ if is_followed => parts.push(vec![message]),
            None if clock_ns.len() <= AFTER_RESTART => parts.push(vec![message]),
            _ => unusable += 1,
        }
    }
    (!parts.is_empty()).then_some((parts, unusable))
}

/// Returns for each message the largest delay that no message around it contradicts: at most its own, and changing by no more
/// than two clocks drift apart.
fn smallest_delays(clock: &[i128], delays: &[i128]) -> Vec<i128> {
    let mut smallest = delays.to_vec();
    let drift = |one: usize, other: usize| ((clock[one] - clock[other]).abs() as f64 * MAX_DRIFT) as i128;
    for message in 1..smallest.len() {
        smallest[message] = smallest[message].min(smallest[message - 1] + drift(message, message - 1));
    }
    for message in (1..smallest.len()).rev() {
        smallest[message - 1] = smallest[message - 1].min(smallest[message] + drift(message, message - 1));
    }
    smallest
}

/// Returns the times of messages without a clock, in the order of arrival. If they were sent at a fixed period their number is
/// the clock.
pub(crate) fn periodic_times(arrivals: &[u64]) -> Vec<u64> {
    let count = arrivals.len();
    if count < 10 * AFTER_RESTART {
        return arrivals.to_vec();
    }
    let period = mean_period(arrivals);
    let clock: Vec<i128> = (0..count).map(|message| (message as f64 * period).round() as i128).collect();
    let delays: Vec<i128> = arrivals.iter().zip(&clock).map(|(at, sent)| i128::from(*at) - sent).collect();
    let smallest = smallest_delays(&clock, &delays);
    // A lost message or a pause moves all that follow: then the number is no clock, and for a while no message is in time.
    let late: Vec<i128> = delays.iter().zip(&smallest).map(|(delay, smallest)| delay - smallest).collect();
    let mut parts = late.chunks(count.div_ceil(MAX_PARTS).max(4 * AFTER_RESTART));
    if !parts.all(|part| part.iter().min().is_some_and(|late| (*late as f64) < 0.5 * period)) {
        return arrivals.to_vec();
    }
    clock.iter().zip(smallest).map(|(sent, delay)| (sent + delay).max(0) as u64).collect()
}

/// Returns the slope of the arrivals over their number by least squares [ns].
fn mean_period(arrivals: &[u64]) -> f64 {
    let (middle, first) = ((arrivals.len() - 1) as f64 / 2.0, arrivals[0]);
    let sums = arrivals.iter().enumerate().fold([0.0; 2], |[products, squares], (index, at)| {
        let offset = index as f64 - middle;
        [products + offset * at.saturating_sub(first) as f64, squares + offset * offset]
    });
    sums[0] / sums[1]
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn times(arrivals: &[u64], clock: &[u64]) -> Vec<u64> {
        let found = sender_times(arrivals, clock);
        assert!(found.is_by_clock);
        found.times.into_iter().map(|time| time.expect("a time")).collect()
    }

    #[test]
    fn bursts_and_jitter_do_not_move_the_times_of_the_sender() {
        let clock: Vec<u64> = (0..1000).map(|step| 7 * MS + 2 * MS * step).collect();
        let expected: Vec<u64> = clock.iter().map(|sent| sent + 500 * MS).collect();
        // Five at a time: all arrive with the last one.
        let arrivals: Vec<u64> = (0..1000).map(|step| clock[(step / 5 * 5 + 4).min(999)] + 500 * MS).collect();
        let worst = |found: &[u64]| found.iter().zip(&expected).map(|(one, other)| one.abs_diff(*other)).max();
        assert!(worst(&times(&arrivals, &clock)) < Some(MS / 100));
        let jitter: Vec<u64> =
            clock.iter().enumerate().map(|(i, sent)| sent + 500 * MS + i as u64 * 7919 % 800_000).collect();
        assert!(worst(&times(&jitter, &clock)) < Some(MS / 20));
    }

    #[test]
    fn drift_of_the_clock_is_followed() {
        let clock: Vec<u64> = (0..20_000).map(|step| 2 * MS * step).collect();
        // 50 millionths fast.
        let arrivals: Vec<u64> =
            clock.iter().enumerate().map(|(i, sent)| sent + sent / 20_000 + (i as u64 % 7) * MS / 2).collect();
        let truth = clock.iter().map(|sent| sent + sent / 20_000);
        let worst = times(&arrivals, &clock).iter().zip(truth).map(|(one, other)| one.abs_diff(other)).max();
        assert!(worst < Some(MS / 5), "{worst:?}");
    }

    #[test]
    fn network_that_stood_still_does_not_split_a_recording() {
        let clock: Vec<u64> = (0..5000).map(|step| 2 * MS * step).collect();
        let arrivals: Vec<u64> =
            clock.iter().map(|sent| if (4000..5000).contains(&(sent / MS)) { 5000 * MS } else { *sent }).collect();
        let found = sender_times(&arrivals, &clock);
        assert_eq!(found.restarts.len(), 0);
        assert!(found.times[2200].expect("a time").abs_diff(clock[2200]) < MS / 5);
    }

    #[test]
    fn one_repeated_value_costs_one_message() {
        let mut clock: Vec<u64> = (0..1000).map(|step| 2 * MS * step).collect();
        let arrivals = clock.clone();
        clock[500] = clock[499];
        clock[700] = 0;
        let found = sender_times(&arrivals, &clock);
        assert_eq!((found.restarts.len(), found.times[500], found.times[700]), (0, None, None));
        assert_eq!(found.times[501], Some(arrivals[501]));
    }

    #[test]
    fn restart_begins_a_new_part() {
        let clock: Vec<u64> =
            (0..1000).map(|step| 2 * MS * if step < 600 { step + 9000 } else { step - 600 }).collect();
        let arrivals: Vec<u64> =
            (0..1000).map(|step| 2 * MS * step + if step < 600 { 0 } else { 30_000 * MS }).collect();
        let found = sender_times(&arrivals, &clock);
        assert_eq!(
            (found.restarts, found.times[600], found.times[599]),
            (vec![600], Some(arrivals[600]), Some(arrivals[599]))
        );
    }

    #[test]
    fn counter_that_is_not_a_clock_is_not_used() {
        let arrivals: Vec<u64> = (0..1000).map(|step| 2 * MS * step).collect();
        let microseconds: Vec<u64> = (0..1000).map(|step| 2 * step).collect();
        for clock in [microseconds, vec![5; 1000]] {
            let found = sender_times(&arrivals, &clock);
            assert!(!found.is_by_clock);
            assert_eq!(found.times[999], Some(arrivals[999]));
        }
        assert!(sender_times(&[], &[]).times.is_empty());
    }

    #[test]
    fn commands_that_arrive_in_bursts_get_their_period() {
        let sent: Vec<u64> = (0..1000).map(|step| 2 * MS * step).collect();
        let arrivals: Vec<u64> = (0..1000).map(|step| sent[(step / 5 * 5 + 4).min(999)]).collect();
        let worst = periodic_times(&arrivals).iter().zip(&sent).map(|(one, other)| one.abs_diff(*other)).max();
        assert!(worst < Some(MS / 2), "{worst:?}");
        let mut irregular = arrivals.clone();
        irregular[600..].iter_mut().for_each(|time| *time += 40 * MS);
        assert_eq!(periodic_times(&irregular), irregular);
    }
}
