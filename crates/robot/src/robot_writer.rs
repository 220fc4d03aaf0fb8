//! Which writer of `rt/lowstate` is the robot.

use std::time::Duration;

use crate::command_datagram::WriterGuid;

/// Silence of the robot after which another writer counts as the robot.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// The writer of the states that is the robot: the first one. States of other writers are dropped and remembered.
#[derive(Debug, Default)]
pub struct RobotWriter {
    /// The robot, with the time of its last state.
    robot: Option<(WriterGuid, Duration)>,
    has_other: bool,
}

impl RobotWriter {
    /// Takes in a state of `writer` at time `now`. Returns true if it is a state of the robot. A robot that does not move may
    /// restart, and is another writer then.
    pub fn accepts(&mut self, writer: WriterGuid, now: Duration, is_moving: bool) -> bool {
        let is_silent = |at: Duration| now.saturating_sub(at) > MAX_SILENCE && !is_moving;
        let accepts = self.robot.is_none_or(|(robot, at)| robot == writer || is_silent(at));
        if accepts {
            self.robot = Some((writer, now));
        } else {
            self.has_other = true;
        }
        accepts
    }

    /// Returns the writer that is the robot.
    pub fn robot(&self) -> Option<WriterGuid> {
        self.robot.map(|(robot, _)| robot)
    }

    /// Returns true if a state of another writer has arrived since the last call. It may have arrived alone, long before a
    /// state of the robot.
    pub fn take_other(&mut self) -> bool {
        std::mem::take(&mut self.has_other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROBOT: WriterGuid = [1; 16];
    const OTHER: WriterGuid = [2; 16];

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn state_of_another_writer_is_dropped_and_remembered_until_it_is_asked_for() {
        let mut writer = RobotWriter::default();
        assert!(writer.accepts(ROBOT, ms(0), false) && !writer.take_other());
        assert!(!writer.accepts(OTHER, ms(1), false));
        assert!(writer.accepts(ROBOT, ms(2), false));
        assert!(writer.take_other());
        assert!(!writer.take_other());
        assert_eq!(writer.robot(), Some(ROBOT));
    }

    #[test]
    fn robot_that_restarts_is_another_writer_but_not_while_it_moves() {
        let mut writer = RobotWriter::default();
        writer.accepts(ROBOT, ms(0), true);
        assert!(!writer.accepts(OTHER, ms(1500), true));
        assert!(writer.accepts(OTHER, ms(1501), false));
        assert_eq!(writer.robot(), Some(OTHER));
    }
}
