//! Commands of a batch of robots, one per SIMD lane.

use crate::Command;
use twinstep_simd::SimdFloat;

/// Commands of a batch of robots for one actuator period.
#[derive(Clone, Copy, Debug)]
pub struct SimdCommands<T> {
    /// Commanded position [rad].
    pub q: [T; 12],
    /// Commanded velocity [rad/s].
    pub dq: [T; 12],
    /// Feed-forward torque [N·m].
    pub tau_ff: [T; 12],
    /// Position gain [N·m/rad].
    pub kp: [T; 12],
    /// Velocity gain [N·m·s/rad].
    pub kd: [T; 12],
}

impl<T: SimdFloat> SimdCommands<T> {
    /// Creates the commands of at most `T::LANES` robots, in the order of the lanes.
    pub fn new(commands: &[Command]) -> Self {
        let zero = [T::splat(0.0); 12];
        let mut this = Self { q: zero, dq: zero, tau_ff: zero, kp: zero, kd: zero };
        for (lane, command) in commands.iter().enumerate() {
            this.set(lane, command);
        }
        this
    }

    /// Sets the command of one robot.
    pub fn set(&mut self, lane: usize, command: &Command) {
        for joint in 0..12 {
            self.q[joint].set(lane, f64::from(command.q[joint]));
            self.dq[joint].set(lane, f64::from(command.dq[joint]));
            self.tau_ff[joint].set(lane, f64::from(command.tau_ff[joint]));
            self.kp[joint].set(lane, f64::from(command.kp[joint]));
            self.kd[joint].set(lane, f64::from(command.kd[joint]));
        }
    }
}
