//! Torque of the PD loop, once per actuator period: command delay, gain errors, saturation, derating and limits.

use super::{SimdActuators, SimdCommands};
use twinstep_model::ActuatorTap;
use twinstep_simd::{SimdFloat, exponential};

use crate::JointValues;

impl<T: SimdFloat, J: JointValues<T>> SimdActuators<T, J> {
    /// Computes the torque of the next actuator period from commands and the sampled state.
    #[inline(always)]
    pub fn update_command(&mut self, commands: &SimdCommands<J>, q: &J, dq: &J) {
        if self.active.command_delay {
            self.delay(commands);
        } else {
            copy(&mut self.arrived[0], &commands.q);
            copy(&mut self.arrived[1], &commands.dq);
            copy(&mut self.arrived[2], &commands.tau_ff);
        }
        self.shift_torque_history();
        for joint in 0..commands.q.as_ref().len() {
            let n = &self.coefficients[joint];
            let (mut kp, mut kd) = (commands.kp[joint], commands.kd[joint]);
            if self.active.pd_gain {
                (kp, kd) = (kp * n.kp_scale, kd * n.kd_scale);
            }
            let (measured_q, measured_dq) = self.encoder_reading(joint, q[joint], dq[joint]);
            let [now_q, now_dq, tau_ff] = [self.arrived[0][joint], self.arrived[1][joint], self.arrived[2][joint]];
            let mut tau = tau_ff + (kp * (now_q - measured_q) + kd * (now_dq - measured_dq));
            if self.active.saturation {
                tau = saturated(tau, n.saturation);
            }
            // NaN must propagate: clipped to the limit, a diverged torque would not be detected.
            let limit = n.torque_limit;
            self.state.torque_history[0][joint] = limit.min((tau * self.derating[joint]).max(-limit));
        }
    }

    /// Sets the torque of the next actuator period [N·m], instead of [`SimdActuators::update_command`].
    #[inline(always)]
    pub fn set_torque(&mut self, torque: &J) {
        self.shift_torque_history();
        copy(&mut self.state.torque_history[0], torque);
    }

    /// Adds a torque [N·m] at a tap until the next call.
    #[inline(always)]
    pub fn set_residual(&mut self, tap: ActuatorTap, torque: J) {
        self.residual = Some((tap, torque));
    }

    #[inline(always)]
    fn shift_torque_history(&mut self) {
        if self.active.torque_delay {
            self.state.torque_history.rotate_right(1);
        }
    }

    /// Appends the commands to the history and computes those that arrive now.
    #[inline(always)]
    fn delay(&mut self, commands: &SimdCommands<J>) {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        self.state.commands.rotate_right(1);
        copy(&mut self.state.commands[0][0], &commands.q);
        copy(&mut self.state.commands[0][1], &commands.dq);
        copy(&mut self.state.commands[0][2], &commands.tau_ff);
        for arrived in &mut self.arrived {
            arrived.as_mut().fill(zero);
        }
        for (age, command) in self.state.commands.iter().enumerate() {
            for joint in 0..commands.q.as_ref().len() {
                // Linear interpolation between the two commands around the delay.
                let off = (self.coefficients[joint].command_delay - T::splat(age as f64)).abs();
                let weight = (one - off).max(zero);
                for quantity in 0..3 {
                    self.arrived[quantity][joint] += weight * command[quantity][joint];
                }
            }
        }
    }
}

#[inline(always)]
fn copy<T: SimdFloat, J: JointValues<T>>(ours: &mut J, given: &J) {
    ours.as_mut().copy_from_slice(given.as_ref());
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
