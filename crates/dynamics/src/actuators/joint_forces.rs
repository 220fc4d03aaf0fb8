//! Torque and friction at the joints, once per physics step: torque delay, back-EMF, dead zone, lag, gain, ripple, gear,
//! friction and spring.

use super::SimdActuators;
use super::coefficients::Coefficients;
use twinstep_model::ActuatorTap;
use twinstep_simd::{SimdFloat, exponential};

use crate::JointValues;

/// Integration steps of a rotor with an elastic gear per physics step.
const GEAR_SUBSTEPS: usize = 8;
/// Damping of an elastic gear, relative to its stiffness [physics steps].
const GEAR_DAMPING: f64 = 0.125;

/// Torque and friction at the joints in one physics step.
#[derive(Clone, Copy, Debug)]
pub struct JointForces<J> {
    /// Torque [N·m or N].
    pub tau: J,
    /// Coefficient of viscous friction [N·m·s/rad or N·s/m].
    pub damping: J,
    /// Maximum torque of dry friction [N·m or N].
    pub dry_friction: J,
}

impl<J> JointForces<J> {
    /// Returns torques without friction.
    pub fn frictionless<T: SimdFloat>(tau: J) -> Self
    where
        J: JointValues<T>,
    {
        let zero = J::filled(tau.as_ref().len(), T::splat(0.0));
        Self { tau, damping: zero.clone(), dry_friction: zero }
    }
}

impl<T: SimdFloat, J: JointValues<T>> SimdActuators<T, J> {
    /// Advances the actuators by physics step `index` of the actuator period. Computes [`SimdActuators::forces`].
    ///
    /// `q` [rad] are the joint positions in the middle of the step, or those of [`SimdActuators::with_sampled_positions`], and
    /// `dq` [rad/s] the velocities.
    #[inline(always)]
    pub fn step(&mut self, index: usize, q: &J, dq: &J) {
        let active = self.active;
        if active.torque_delay {
            self.delay_torque(index);
        }
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        for joint in 0..q.as_ref().len() {
            let n = &self.coefficients[joint];
            // Back-EMF and ripple depend on the rotor, whose motion differs from the link's if the gear is elastic.
            let rotor_q = zero.select_lt(n.gear, self.state.rotor[0][joint], q[joint]);
            let rotor_dq = zero.select_lt(n.gear, self.state.rotor[1][joint], dq[joint]);
            let input = if active.torque_delay { &self.delayed_torque } else { &self.state.torque_history[0] };
            let mut tau = input[joint];
            if active.back_emf {
                let (limit, share) = (n.torque_limit, rotor_dq * n.back_emf);
                let forth = limit * (one - share).max(zero).min(one);
                let back = limit * (one + share).max(zero).min(one);
                tau = forth.min(tau.max(-back));
            }
            if active.dead_zone {
                let size = (tau.abs() - n.dead_zone).max(zero);
                // Robots without a dead zone keep the bits of their torque.
                tau = zero.select_lt(n.dead_zone, tau.select_lt(zero, -size, size), tau);
            }
            let (current, input) = (&mut self.state.current[joint], tau);
            self.estimated_torque[joint] = input + n.lag_mean * (*current - input);
            *current += n.lag * (input - *current);
            if let Some((ActuatorTap::Current, residual)) = &self.residual {
                self.estimated_torque[joint] += residual[joint];
            }
            tau = n.gain * self.estimated_torque[joint];
            if active.ripple {
                let (sin, _) = (n.ripple_cycles * rotor_q + n.ripple_phase).sin_cos();
                tau += n.ripple_amplitude * sin;
            }
            let forces = &mut self.forces;
            (forces.damping[joint], forces.dry_friction[joint]) = (n.viscous, n.coulomb);
            if active.speed_friction {
                let speed = dq[joint] * n.inv_stribeck_velocity;
                forces.dry_friction[joint] += n.breakaway * exponential(-(speed * speed)) + n.load * tau.abs();
            }
            forces.tau[joint] = tau;
        }
        if active.elastic {
            self.integrate_gear(q, dq);
        }
        let tau = &mut self.forces.tau;
        if let Some((ActuatorTap::Output, residual)) = &self.residual {
            for joint in 0..q.as_ref().len() {
                tau[joint] += residual[joint];
            }
        }
        if active.spring {
            for joint in 0..q.as_ref().len() {
                let n = &self.coefficients[joint];
                tau[joint] += n.spring_offset - n.spring * q[joint];
            }
        }
    }

    /// Returns torque and friction of the last physics step.
    #[inline(always)]
    pub fn forces(&self) -> &JointForces<J> {
        &self.forces
    }

    /// Computes the mean of the delayed torque over physics step `index` [N·m].
    #[inline(always)]
    fn delay_torque(&mut self, index: usize) {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let start = self.step_fraction * T::splat(index as f64);
        for (joint, n) in self.coefficients.iter().enumerate() {
            let (from, mut delayed) = (start - n.torque_delay, zero);
            let to = from + self.step_fraction;
            for (age, torque) in self.state.torque_history.iter().enumerate() {
                let period = T::splat(-(age as f64));
                let shared = (to.min(period + one) - from.max(period)).max(zero);
                delayed += shared / self.step_fraction * torque[joint];
            }
            // Without delay the exact value, so that the result does not depend on the other lanes.
            self.delayed_torque[joint] = zero.select_lt(n.torque_delay, delayed, self.state.torque_history[0][joint]);
        }
    }

    /// Integrates the rotors of elastic gears in substeps with constant link velocities.
    ///
    /// Each substep evaluates the torque in its middle, so that rotor and link are at the same time. Without damping, a stiff
    /// gear between rotor and link would vibrate at a frequency that the physics step does not resolve. Replaces the torque by
    /// the mean that the gear transmits to the link [N·m].
    #[inline(always)]
    fn integrate_gear(&mut self, q: &J, dq: &J) {
        let (zero, dt) = (T::splat(0.0), T::splat(self.dt / GEAR_SUBSTEPS as f64));
        let (half, lead) = (T::splat(0.5) * dt, T::splat(self.lead));
        let damping_time = T::splat(GEAR_DAMPING * self.dt);
        let ([angle, speed], tau) = (&mut self.state.rotor, &mut self.forces.tau);
        for joint in 0..q.as_ref().len() {
            let Coefficients { half_backlash, gear: stiffness, rotor, .. } = self.coefficients[joint];
            let (mut link, mut mean) = (q[joint] - lead * dq[joint], zero);
            for _ in 0..GEAR_SUBSTEPS {
                angle[joint] += half * speed[joint];
                link += half * dq[joint];
                let twist = angle[joint] - link;
                let spring = (twist - half_backlash).max(zero) + (twist + half_backlash).min(zero);
                let damper = damping_time * (speed[joint] - dq[joint]);
                let transmitted = stiffness * (spring + half_backlash.select_lt(twist.abs(), damper, zero));
                speed[joint] += dt * (tau[joint] - transmitted) / rotor;
                angle[joint] += half * speed[joint];
                link += half * dq[joint];
                mean += transmitted * T::splat(1.0 / GEAR_SUBSTEPS as f64);
            }
            tau[joint] = zero.select_lt(stiffness, mean, tau[joint]);
        }
    }
}
