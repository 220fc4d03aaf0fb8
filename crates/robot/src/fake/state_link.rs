//! The way of the states from the robot to the network: loss, delay, reordering, pauses.

use rand::RngExt;
use twinstep_model::{Stream, stream};
use twinstep_unitree::LowState;

/// States on their way.
#[derive(Clone, Debug)]
pub(super) struct StateLink {
    random: Stream,
    /// States with the time at which they are published [ms].
    queue: Vec<(u64, LowState)>,
    count: u64,
    pub faults: LinkFaults,
}

/// What happens to states on their way.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct LinkFaults {
    /// Share of lost states, 0 to 1.
    pub loss: f32,
    /// Delay [ms].
    pub delay_ms: u64,
    /// True if every second state is published after the one that follows it.
    pub reorder: bool,
    /// Time until which no states are made [ms].
    pub silent_until_ms: u64,
    /// True if only every tenth state is published.
    pub slow: bool,
}

impl StateLink {
    pub fn new(seed: u64) -> Self {
        Self { random: stream(seed, "fake_link", 0), queue: Vec::new(), count: 0, faults: LinkFaults::default() }
    }

    /// Forgets every state on its way.
    pub fn clear(&mut self) {
        self.queue.clear();
    }

    /// Takes in the state of this step, and returns the states to publish now.
    pub fn pass(&mut self, state: LowState, now_ms: u64) -> Vec<LowState> {
        let faults = self.faults;
        self.count += 1;
        let is_lost = faults.loss > 0.0 && self.random.random::<f32>() < faults.loss;
        let is_left_out = faults.slow && !self.count.is_multiple_of(10);
        if !is_lost && !is_left_out && now_ms >= faults.silent_until_ms {
            // Two periods more than the state that follows, which so arrives first.
            let behind = if faults.reorder && self.count.is_multiple_of(2) { 3 } else { 0 };
            self.queue.push((now_ms + faults.delay_ms + behind, state));
        }
        let (mut due, later): (Vec<_>, Vec<_>) = self.queue.drain(..).partition(|(at, _)| *at <= now_ms);
        self.queue = later;
        due.sort_by_key(|(at, _)| *at);
        due.into_iter().map(|(_, state)| state).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the ticks of the states that are published in 100 steps, with the time of each [ms].
    fn ticks(faults: LinkFaults) -> Vec<(u64, u32)> {
        let mut link = StateLink::new(1);
        link.faults = faults;
        let times = (0..100).map(|step| 2 * step);
        times
            .flat_map(|now| {
                let states = link.pass(LowState { tick: now as u32, ..LowState::default() }, now);
                states.into_iter().map(move |state| (now, state.tick)).collect::<Vec<_>>()
            })
            .collect()
    }

    #[test]
    fn each_fault_does_what_it_says() {
        let none = LinkFaults::default();
        assert!(ticks(none).iter().all(|(now, tick)| *now == u64::from(*tick)));
        let lost = 100 - ticks(LinkFaults { loss: 0.3, ..none }).len();
        assert!((15..45).contains(&lost), "{lost}");
        assert!(ticks(LinkFaults { delay_ms: 6, ..none }).iter().all(|(now, tick)| *now == u64::from(*tick) + 6));
        let reordered = ticks(LinkFaults { reorder: true, ..none });
        assert!(reordered.windows(2).any(|pair| pair[1].1 < pair[0].1), "{reordered:?}");
        assert_eq!(ticks(LinkFaults { silent_until_ms: 50, ..none })[0], (50, 50));
        assert_eq!(ticks(LinkFaults { slow: true, ..none }).len(), 10);
    }
}
