//! Decides when the watchdog damps the motors.

use std::time::Duration;

/// Longest time between two steps that counts as silence of the control loop. In a longer one this process did not run
/// either, so the computer stood still, and what the control loop sent meanwhile is not read yet.
const MAX_SILENT_STEP: Duration = Duration::from_millis(5);
/// Time for which the motors are damped after the end of the control loop, so that the robot lies when commands cease.
const FINAL_DAMPING: Duration = Duration::from_millis(1500);

/// What the watchdog does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The robot is not armed.
    Idle,
    /// The control loop commands the motors.
    Guard,
    /// The watchdog damps the motors.
    TakeOver,
    /// Nothing is left to do.
    End,
}

/// State of the watchdog, without a clock and without a network.
#[derive(Clone, Debug)]
pub struct WatchdogMachine {
    timeout: Duration,
    mode: Mode,
    generation: u32,
    now: Duration,
    silence: Duration,
    /// Since when the control loop's end of the socket is closed.
    closed_since: Option<Duration>,
}

impl WatchdogMachine {
    /// Returns a machine that takes over after `timeout` without a beat.
    pub fn new(timeout: Duration) -> Self {
        Self {
            timeout,
            mode: Mode::Idle,
            generation: 0,
            now: Duration::ZERO,
            silence: Duration::ZERO,
            closed_since: None,
        }
    }

    /// Guards the writer of `generation`. After a takeover, only a later generation ends it: its writer is a new one.
    /// Returns true if the writer is guarded from now on.
    pub fn guard(&mut self, generation: u32) -> bool {
        if self.mode == Mode::TakeOver && generation <= self.generation {
            return false;
        }
        // New addresses of the readers of the same writer are no sign that it commands the motors.
        if self.mode != Mode::Guard || generation != self.generation {
            self.silence = Duration::ZERO;
        }
        (self.mode, self.generation) = (Mode::Guard, generation);
        true
    }

    /// Takes in that the control loop has sent a command with the writer of `generation`.
    pub fn beat(&mut self, generation: u32) {
        if generation == self.generation {
            self.silence = Duration::ZERO;
        }
    }

    /// Ends guarding: the robot is not armed any more.
    pub fn release(&mut self) {
        self.mode = Mode::Idle;
    }

    /// Takes in that the control loop has ended.
    pub fn close(&mut self) {
        self.closed_since.get_or_insert(self.now);
    }

    /// Advances to `now`. What arrived before has to be taken in first.
    pub fn step(&mut self, now: Duration) -> Mode {
        self.silence += now.saturating_sub(self.now).min(MAX_SILENT_STEP);
        self.now = now;
        let closed_for = self.closed_since.map(|since| now.saturating_sub(since));
        self.mode = match (self.mode, closed_for) {
            (Mode::Guard, Some(_)) => Mode::TakeOver,
            (Mode::Guard, None) if self.silence > self.timeout => Mode::TakeOver,
            (Mode::Idle, Some(_)) => Mode::End,
            (Mode::TakeOver, Some(closed_for)) if closed_for > FINAL_DAMPING => Mode::End,
            (mode, _) => mode,
        };
        self.mode
    }

    /// Returns the generation of the last writer that was guarded.
    pub fn generation(&self) -> u32 {
        self.generation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_millis(20);

    fn ms(time: u64) -> Duration {
        Duration::from_millis(time)
    }

    /// Returns a machine at 100 ms that has guarded generation 1 since then.
    fn guarding() -> WatchdogMachine {
        let mut machine = WatchdogMachine::new(TIMEOUT);
        machine.step(ms(100));
        assert!(machine.guard(1));
        machine
    }

    /// Steps every 2 ms and returns the time of the first step in `mode` [ms].
    fn first_in(machine: &mut WatchdogMachine, from: u64, mode: Mode) -> Option<u64> {
        (from / 2..from / 2 + 2000).map(|step| 2 * step).find(|at| machine.step(ms(*at)) == mode)
    }

    #[test]
    fn control_loop_that_beats_is_left_alone() {
        let mut machine = guarding();
        for at in 51..2000 {
            machine.beat(1);
            assert_eq!(machine.step(ms(2 * at)), Mode::Guard);
        }
    }

    #[test]
    fn new_readers_of_a_silent_writer_are_no_beat() {
        let mut machine = guarding();
        for time in 101..=120 {
            assert!(machine.guard(1));
            assert_eq!(machine.step(ms(time)), Mode::Guard);
        }
        assert_eq!(machine.step(ms(121)), Mode::TakeOver);
    }

    #[test]
    fn silent_control_loop_is_taken_over_from_after_the_timeout() {
        let mut machine = guarding();
        assert_eq!(first_in(&mut machine, 102, Mode::TakeOver), Some(122));
        assert_eq!(first_in(&mut machine, 124, Mode::End), None, "it may be suspended for long");
    }

    #[test]
    fn ended_control_loop_is_taken_over_from_at_once_and_damped_for_1500_ms() {
        let mut machine = guarding();
        machine.close();
        assert_eq!(machine.step(ms(102)), Mode::TakeOver);
        assert_eq!(first_in(&mut machine, 104, Mode::End), Some(1602));
    }

    #[test]
    fn control_loop_that_comes_back_gets_the_motors_with_a_new_writer_only() {
        let mut machine = guarding();
        first_in(&mut machine, 102, Mode::TakeOver);
        machine.beat(1);
        assert!(!machine.guard(1), "the readers ignore this writer's commands");
        assert_eq!(machine.step(ms(130)), Mode::TakeOver);
        assert!(machine.guard(2));
        assert_eq!(machine.step(ms(132)), Mode::Guard);
        machine.beat(1);
        assert_eq!(first_in(&mut machine, 134, Mode::TakeOver), Some(152), "beats of the old writer do not count");
    }

    #[test]
    fn pause_of_the_whole_computer_is_no_silence() {
        let mut machine = guarding();
        assert_eq!(machine.step(ms(180)), Mode::Guard, "the beats of these 80 ms are not read yet");
        machine.beat(1);
        assert_eq!(machine.step(ms(182)), Mode::Guard);
    }

    #[test]
    fn control_loop_that_disarms_first_ends_without_damping() {
        let mut machine = guarding();
        machine.release();
        assert_eq!(first_in(&mut machine, 102, Mode::TakeOver), None);
        machine.close();
        assert_eq!(machine.step(ms(9000)), Mode::End);
    }
}
