//! Expected states of a client's counters, against which observations are checked.

use twinstep_envs::{Counter, OBS_LEN};

/// Number of counters per client. Their actions differ, so that exchanged rows are detected.
pub const NUM_ENVS: usize = 2;

/// Possible states of the counters.
///
/// There is one, or two after the termination of a client: its last request was executed, or was not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StepOracle {
    possible: Vec<[Counter; NUM_ENVS]>,
}

impl StepOracle {
    /// Returns the state of new environments after one reset.
    pub fn after_first_reset() -> Self {
        Self { possible: vec![[Counter { resets: 1, ..Counter::default() }; NUM_ENVS]] }
    }

    /// Returns both possible states after the termination of a client with a request in flight.
    pub fn after_client_crash(acknowledged: [Counter; NUM_ENVS]) -> Self {
        let mut executed = acknowledged;
        step(&mut executed, &actions(&acknowledged));
        Self { possible: vec![acknowledged, executed] }
    }

    /// Returns the next actions. They are a function of the state, so a reclaiming client knows those last sent.
    pub fn actions(&self) -> Vec<f32> {
        actions(&self.possible[0])
    }

    /// Advances the possible states by `actions` and checks the observations. Fails if no possible state matches.
    pub fn observe(&mut self, actions: &[f32], obs: &[f32]) -> Result<[Counter; NUM_ENVS], String> {
        for counters in &mut self.possible {
            step(counters, actions);
        }
        self.settle(obs)
    }

    /// Checks observations without a preceding step.
    pub fn settle(&mut self, obs: &[f32]) -> Result<[Counter; NUM_ENVS], String> {
        let observed: Vec<&[f32]> = obs.chunks_exact(OBS_LEN).map(|row| &row[..4]).collect();
        let expected = self.possible.clone();
        self.possible.retain(|counters| counters.iter().map(Counter::observation).eq(observed.iter().copied()));
        match self.possible[..] {
            [counters] => Ok(counters),
            _ => Err(format!("observed {observed:?}; possible: {expected:?}")),
        }
    }
}

/// Returns sixteen-bit numbers that are a function of the state.
fn actions(counters: &[Counter; NUM_ENVS]) -> Vec<f32> {
    let value = |counter: &Counter, env: usize, joint: usize| {
        let seed = counter.action_hash ^ (counter.steps * 97 + env as u32 * 31 + joint as u32);
        (seed.wrapping_mul(0x9e37_79b9) >> 16) as f32
    };
    let entries =
        counters.iter().enumerate().flat_map(|(env, counter)| (0..12).map(move |joint| (counter, env, joint)));
    entries.map(|(counter, env, joint)| value(counter, env, joint)).collect()
}

fn step(counters: &mut [Counter; NUM_ENVS], actions: &[f32]) {
    for (counter, action) in counters.iter_mut().zip(actions.chunks_exact(12)) {
        counter.step(action);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observation(counters: &[Counter; NUM_ENVS]) -> Vec<f32> {
        counters.iter().flat_map(|counter| [counter.observation().to_vec(), vec![0.0; OBS_LEN - 4]].concat()).collect()
    }

    #[test]
    fn step_executed_twice_or_skipped_is_detected() {
        for executed in [0, 2] {
            let mut oracle = StepOracle::after_first_reset();
            let mut counters = oracle.possible[0];
            let actions = oracle.actions();
            for _ in 0..executed {
                step(&mut counters, &actions);
            }
            assert!(oracle.observe(&actions, &observation(&counters)).is_err(), "{executed} times");
        }
    }

    #[test]
    fn reclaiming_client_accepts_the_last_request_executed_once_or_not_at_all() {
        let acknowledged = [Counter { steps: 5, resets: 1, action_hash: 77 }; NUM_ENVS];
        let sent = actions(&acknowledged);
        for executed in 0..3 {
            let mut counters = acknowledged;
            for _ in 0..executed {
                step(&mut counters, &sent);
            }
            let mut oracle = StepOracle::after_client_crash(acknowledged);
            let next = oracle.actions();
            step(&mut counters, &next);
            assert_eq!(oracle.observe(&next, &observation(&counters)).is_ok(), executed < 2, "{executed} times");
        }
    }
}
