//! Commands of a batch of robots, one per SIMD lane.

use twinstep_model::Command;
use twinstep_simd::SimdFloat;

use crate::JointValues;

/// Commands of a batch of robots for one actuator period.
#[derive(Clone, Copy, Debug)]
pub struct SimdCommands<J> {
    /// Commanded position [rad or m].
    pub q: J,
    /// Commanded velocity [rad/s or m/s].
    pub dq: J,
    /// Feed-forward torque [N·m or N].
    pub tau_ff: J,
    /// Position gain [N·m/rad or N/m].
    pub kp: J,
    /// Velocity gain [N·m·s/rad or N·s/m].
    pub kd: J,
}

impl<J> SimdCommands<J> {
    /// Returns commands of zero torque.
    pub fn zero<T: SimdFloat>(num_joints: usize) -> Self
    where
        J: JointValues<T>,
    {
        let zero = J::filled(num_joints, T::splat(0.0));
        Self { q: zero.clone(), dq: zero.clone(), tau_ff: zero.clone(), kp: zero.clone(), kd: zero }
    }

    /// Sets the commanded positions [rad or m], velocities and gains of one robot.
    pub fn set_targets<T: SimdFloat>(&mut self, lane: usize, q: &[f32], dq: &[f32], tau_ff: &[f32], gains: [&[f32]; 2])
    where
        J: JointValues<T>,
    {
        let given = [q, dq, tau_ff, gains[0], gains[1]];
        for (ours, given) in
            [&mut self.q, &mut self.dq, &mut self.tau_ff, &mut self.kp, &mut self.kd].into_iter().zip(given)
        {
            for (ours, given) in ours.as_mut().iter_mut().zip(given) {
                ours.set(lane, f64::from(*given));
            }
        }
    }

    /// Sets the command of one robot.
    pub fn set<T: SimdFloat>(&mut self, lane: usize, command: &Command)
    where
        J: JointValues<T>,
    {
        let Command { q, dq, tau_ff, kp, kd } = command;
        self.set_targets(lane, q, dq, tau_ff, [kp, kd]);
    }
}

impl<T: SimdFloat> SimdCommands<[T; 12]> {
    /// Creates the commands of at most `T::LANES` robots, in the order of the lanes.
    pub fn new(commands: &[Command]) -> Self {
        let mut this = Self::zero(12);
        for (lane, command) in commands.iter().enumerate() {
            this.set(lane, command);
        }
        this
    }
}
