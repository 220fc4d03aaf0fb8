//! Commands that arrive late.

use std::collections::VecDeque;

use twinstep_model::{Command, NUM_JOINTS, PerJoint, RobotModel};

/// Commands of one robot on their way to its actuators.
#[derive(Clone, Debug)]
pub struct CommandDelay {
    /// Delay of each joint [actuator periods].
    periods: [f64; NUM_JOINTS],
    /// Commands of the last periods, newest first.
    recent: VecDeque<Command>,
}

impl CommandDelay {
    /// Returns the delay of `robot`, which rests with its joints at `q` [rad]; `None` if commands arrive at once.
    pub fn new(robot: &RobotModel, q: &PerJoint) -> Option<Self> {
        let periods = robot.joints.map(|joint| joint.actuator.command_delay / robot.control.actuator_dt());
        let longest = periods.iter().fold(0.0_f64, |longest, period| longest.max(*period));
        // The two commands around the longest delay.
        let len = longest.floor() as usize + 2;
        (longest > 0.0).then(|| Self { periods, recent: vec![Command::hold(*q, 0.0, 0.0); len].into() })
    }

    /// Takes the command of the next actuator period, and returns the one that arrives: linear interpolation between the
    /// two commands around the delay. Gains are those of the newest command.
    pub fn next(&mut self, command: &Command) -> Command {
        self.recent.pop_back();
        self.recent.push_front(*command);
        let mut arrived = *command;
        for (joint, periods) in self.periods.iter().enumerate() {
            let (age, part) = (periods.floor() as usize, periods.fract() as f32);
            let newer = &self.recent[age];
            let older = self.recent.get(age + 1).unwrap_or(newer);
            let between = |newer: f32, older: f32| newer + part * (older - newer);
            arrived.q[joint] = between(newer.q[joint], older.q[joint]);
            arrived.dq[joint] = between(newer.dq[joint], older.dq[joint]);
            arrived.tau_ff[joint] = between(newer.tau_ff[joint], older.tau_ff[joint]);
        }
        arrived
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use twinstep_model::go2;

    #[test]
    fn command_arrives_after_its_delay_and_gains_at_once() {
        let mut robot = go2();
        // Actuator periods of 5 ms: one and a half.
        robot.joints[3].actuator.command_delay = 0.0075;
        let mut delay = CommandDelay::new(&robot, &[1.0; NUM_JOINTS]).expect("a delay");
        let arrived: Vec<_> = (0..3).map(|_| delay.next(&Command::hold([2.0; NUM_JOINTS], 30.0, 1.0))).collect();
        assert_eq!(arrived.iter().map(|command| command.q[3]).collect::<Vec<_>>(), [1.0, 1.5, 2.0]);
        assert!(arrived.iter().all(|command| command.q[4] == 2.0 && command.kp[3] == 30.0));
        assert!(CommandDelay::new(&go2(), &[1.0; NUM_JOINTS]).is_none());
    }
}
