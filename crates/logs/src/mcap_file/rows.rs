//! Rows of a log from messages: each state of the robot with the command in force.

use twinstep_unitree::{NO_POSITION, NO_VELOCITY};

use crate::go2_message::{LowCmd, LowState, MotorCmd};

/// State with the command in force from it to the next state.
pub(crate) struct StateWithCommand<'a> {
    pub time: u64,
    pub state: &'a LowState,
    pub command: LowCmd,
}

impl StateWithCommand<'_> {
    /// Replaces the robot's special values (no position, no velocity, stopped motor) by gains of 0.
    ///
    /// Returns the number of motor commands without a position or with a stopped motor.
    pub fn normalise_stop_commands(&mut self) -> usize {
        let mut stops = 0;
        for (command, state) in self.command.motors.iter_mut().zip(&self.state.motors) {
            if command.mode == 0 {
                *command = MotorCmd { mode: 0, q: state.q, ..MotorCmd::default() };
                stops += 1;
            }
            if command.q >= NO_POSITION {
                (command.q, command.kp) = (state.q, 0.0);
                stops += 1;
            }
            if command.dq == NO_VELOCITY {
                (command.dq, command.kd) = (0.0, 0.0);
            }
        }
        stops
    }
}

/// Returns the median time between rows [ns]; zero for a single row.
pub(crate) fn median_step(times: impl IntoIterator<Item = u64>) -> u64 {
    let times: Vec<u64> = times.into_iter().collect();
    let mut steps: Vec<u64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_unstable();
    steps.get(steps.len() / 2).copied().unwrap_or(0)
}

/// Returns for each state the index of the command in force midway between it and the next state.
///
/// A controller's command arrives shortly after the state that it responds to, and is in force for most of the
/// interval. All times are increasing; `median` is the median time between states [ns].
pub(crate) fn commands_in_force(states: &[u64], commands: &[u64], median: u64) -> Vec<Option<usize>> {
    let mut next = 0;
    let in_force = |(row, time): (usize, &u64)| {
        let step = states.get(row + 1).map_or(median, |later| later - time);
        let middle = time + step.min(median) / 2;
        while commands.get(next).is_some_and(|time| *time <= middle) {
            next += 1;
        }
        next.checked_sub(1)
    };
    states.iter().enumerate().map(in_force).collect()
}
