//! Torque of the PD loop, once per actuator period: command delay, gain errors, saturation, derating and limits.

use super::{SimdActuators, SimdCommands};
use crate::ActuatorTap;
use twinstep_simd::{SimdFloat, exponential};

impl<T: SimdFloat> SimdActuators<T> {
    /// Computes the torque of the next actuator period from commands and the sampled state.
    #[inline(always)]
    pub fn update_command(&mut self, commands: &SimdCommands<T>, q: &[T; 12], dq: &[T; 12]) {
        let now =
            if self.active.command_delay { self.delayed(commands) } else { [commands.q, commands.dq, commands.tau_ff] };
        let mut torque = [T::splat(0.0); 12];
        for joint in 0..12 {
            let n = &self.coefficients[joint];
            let (mut kp, mut kd) = (commands.kp[joint], commands.kd[joint]);
            if self.active.pd_gain {
                (kp, kd) = (kp * n.kp_scale, kd * n.kd_scale);
            }
            let (measured_q, measured_dq) = self.encoder_reading(joint, q[joint], dq[joint]);
            let mut tau = now[2][joint] + (kp * (now[0][joint] - measured_q) + kd * (now[1][joint] - measured_dq));
            if self.active.saturation {
                tau = saturated(tau, n.saturation);
            }
            // NaN must propagate: clipped to the limit, a diverged torque would not be detected.
            let limit = n.torque_limit;
            torque[joint] = limit.min((tau * self.derating[joint]).max(-limit));
        }
        self.set_torque(torque);
    }

    /// Sets the torque of the next actuator period [N·m], instead of [`SimdActuators::update_command`].
    #[inline(always)]
    pub fn set_torque(&mut self, torque: [T; 12]) {
        if self.active.torque_delay {
            let last = self.state.torque_history.len() - 1;
            self.state.torque_history.copy_within(0..last, 1);
        }
        self.state.torque_history[0] = torque;
    }

    /// Adds a torque [N·m] at a tap until the next call.
    #[inline(always)]
    pub fn set_residual(&mut self, tap: ActuatorTap, torque: [T; 12]) {
        self.residual = Some((tap, torque));
    }

    /// Appends the commands to the history and returns those that arrive now.
    #[inline(always)]
    fn delayed(&mut self, commands: &SimdCommands<T>) -> [[T; 12]; 3] {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let last = self.state.commands.len() - 1;
        self.state.commands.copy_within(0..last, 1);
        self.state.commands[0] = [commands.q, commands.dq, commands.tau_ff];
        let mut arrived = [[zero; 12]; 3];
        for (age, command) in self.state.commands.iter().enumerate() {
            for joint in 0..12 {
                // Linear interpolation between the two commands around the delay.
                let off = (self.coefficients[joint].command_delay - T::splat(age as f64)).abs();
                let weight = (one - off).max(zero);
                for quantity in 0..3 {
                    arrived[quantity][joint] += weight * command[quantity][joint];
                }
            }
        }
        arrived
    }
}

/// Returns `κ · tanh(τ / κ)`, given 1 / κ.
#[inline(always)]
fn saturated<T: SimdFloat>(tau: T, inverse: T) -> T {
    let one = T::splat(1.0);
    // tanh x = sign(x) (1 − e) / (1 + e) with e = exp(−2 |x|).
    let e = exponential(-((tau * inverse).abs() * T::splat(2.0)));
    let size = (one - e) / ((one + e) * inverse.max(T::splat(1e-9)));
    let limited = tau.select_lt(T::splat(0.0), -size, size);
    // No saturation, or κ so large that tanh x equals x.
    inverse.select_lt(T::splat(1e-9), tau, limited)
}
