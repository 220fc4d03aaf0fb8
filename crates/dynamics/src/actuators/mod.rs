//! Actuators of a batch of robots, one per SIMD lane: torque from commands, and friction and springs at the joints.
//!
//! [`SimdActuators::update_command`] runs once per actuator period on the sampled state; [`SimdActuators::step`] runs
//! once per physics step. Both engines use this code. An effect that no robot in the batch has costs one branch per
//! step.
//!
//! - [`commands`]: commands, one robot per lane.
//! - [`coefficients`]: numbers of the laws, computed from a [`JointModel`].
//! - [`pd_loop`]: the laws that act once per actuator period.
//! - [`joint_forces`]: the laws that act once per physics step.

mod coefficients;
mod commands;
mod joint_forces;
mod pd_loop;
#[cfg(test)]
mod tests;

use twinstep_model::{ActuatorParams, ActuatorTap, JointModel};
use twinstep_simd::SimdFloat;

use crate::JointValues;

use coefficients::{ActiveEffects, Coefficients, gear_stiffness};
pub use commands::SimdCommands;
pub use joint_forces::JointForces;

/// State of the actuators between physics steps.
#[derive(Clone, Debug)]
struct ActuatorState<J> {
    /// Position [rad], velocity [rad/s] and feed-forward torque [N·m] of the last commands, newest first.
    commands: Vec<[J; 3]>,
    /// Torque of the PD loop in the last actuator periods, newest first [N·m].
    torque_history: Vec<J>,
    /// Torque after the first-order lag, proportional to the motor current [N·m].
    current: J,
    /// Position [rad] and velocity [rad/s] of the rotor of an elastic gear.
    rotor: [J; 2],
}

/// Actuators of a batch of robots, one per lane. `J` has a number for each joint. Torques of sliding joints are forces [N].
#[derive(Clone, Debug)]
pub struct SimdActuators<T, J> {
    coefficients: Vec<Coefficients<T>>,
    state: ActuatorState<J>,
    /// Torque that the current sensor measures, mean over the last physics step [N·m].
    estimated_torque: J,
    /// Factor on the torque for supply voltage and motor temperature.
    derating: J,
    /// Torque that is added at a tap in the current actuator period [N·m].
    residual: Option<(ActuatorTap, J)>,
    active: ActiveEffects,
    /// Position, velocity and feed-forward torque of the commands that arrive in the current actuator period.
    arrived: [J; 3],
    /// Torque of the PD loop after its delay [N·m].
    delayed_torque: J,
    /// Torque and friction of the last physics step.
    forces: JointForces<J>,
    /// Physics step [actuator periods].
    step_fraction: T,
    /// Physics step [s].
    dt: f64,
    /// Time from a sample to the link positions of [`SimdActuators::step`] after it [s].
    lead: f64,
    actuator_dt: f64,
}

/// Returns the rotor inertia that moves with the link of a joint [kg·m²]; 0 if the gear is elastic.
pub fn link_armature(joint: &JointModel) -> f64 {
    if gear_stiffness(&joint.actuator) > 0.0 { 0.0 } else { joint.armature }
}

impl<T: SimdFloat, J: JointValues<T>> SimdActuators<T, J> {
    /// Creates the actuators of `joints` in every lane, with zero torque, for physics steps of `dt` [s].
    ///
    /// Link positions of a step are those of its middle, half a step after a sample.
    pub fn new(joints: &[JointModel], actuator_dt: f64, dt: f64) -> Self {
        let (zero, one) = (J::filled(joints.len(), T::splat(0.0)), J::filled(joints.len(), T::splat(1.0)));
        let three = || std::array::from_fn(|_| zero.clone());
        let length = history_len(actuator_dt);
        let state = ActuatorState {
            commands: vec![three(); length],
            torque_history: vec![zero.clone(); length],
            current: zero.clone(),
            rotor: [zero.clone(), zero.clone()],
        };
        Self {
            coefficients: joints.iter().map(|joint| Coefficients::splat(joint, dt, actuator_dt)).collect(),
            state,
            estimated_torque: zero.clone(),
            derating: one,
            residual: None,
            active: ActiveEffects::default(),
            arrived: three(),
            delayed_torque: zero.clone(),
            forces: JointForces { tau: zero.clone(), damping: zero.clone(), dry_friction: zero },
            step_fraction: T::splat(dt / actuator_dt),
            dt,
            lead: 0.5 * dt,
            actuator_dt,
        }
    }

    /// Returns the actuators for a simulator whose samples are the link positions of its steps.
    pub fn with_sampled_positions(self) -> Self {
        Self { lead: 0.0, ..self }
    }

    /// Resets the actuators of one lane to those of `joints`, at positions `q` and velocities `dq` of the links and zero torque.
    pub fn set(&mut self, lane: usize, joints: &[JointModel], q: &[f64], dq: &[f64]) {
        for (index, joint) in joints.iter().enumerate() {
            self.coefficients[index].set(lane, joint, self.dt, self.actuator_dt);
            let state = &mut self.state;
            // The command history is the initial position, so a delayed first command starts from rest.
            for command in &mut state.commands {
                command[0][index].set(lane, q[index] + joint.actuator.encoder_error(dq[index]));
                command[1][index].set(lane, 0.0);
                command[2][index].set(lane, 0.0);
            }
            for torque in &mut state.torque_history {
                torque[index].set(lane, 0.0);
            }
            state.current[index].set(lane, 0.0);
            state.rotor[0][index].set(lane, q[index]);
            state.rotor[1][index].set(lane, dq[index]);
            self.derating[index].set(lane, 1.0);
        }
        self.update_active_effects();
    }

    /// Sets the factors on the torque of one lane for supply voltage and motor temperature. A reset sets them to 1.
    pub fn set_derating(&mut self, lane: usize, factors: &[f32]) {
        for (derating, factor) in self.derating.as_mut().iter_mut().zip(factors) {
            derating.set(lane, f64::from(*factor));
        }
    }

    /// Returns true if any actuator in the batch has a delay or lag, so that its torque depends on earlier periods.
    pub fn has_memory(&self) -> bool {
        let has_lag = |n: &Coefficients<T>| n.lag.any_lt(T::splat(1.0));
        self.active.command_delay || self.active.torque_delay || self.coefficients.iter().any(has_lag)
    }

    /// Replays one past actuator period of `steps` physics steps into the delay and lag states.
    ///
    /// Positions do not change. `q` [rad] and `dq` [rad/s] are the encoder readings at the start of the period.
    pub fn replay_history(&mut self, commands: &SimdCommands<J>, q: &J, dq: &J, steps: usize) {
        let rotors = self.state.rotor.clone();
        let mut link = q.clone();
        for (joint, n) in self.coefficients.iter().enumerate() {
            link[joint] = q[joint] - n.encoder_offset - n.encoder_lead * dq[joint];
        }
        self.state.rotor = [link.clone(), dq.clone()];
        self.update_command(commands, &link, dq);
        for index in 0..steps {
            self.step(index, &link, dq);
            self.state.rotor = [link.clone(), dq.clone()];
        }
        self.state.rotor = rotors;
    }

    fn update_active_effects(&mut self) {
        self.active = ActiveEffects::of(&self.coefficients);
    }

    /// Returns the encoder reading [rad], [rad/s] of a joint whose link is at `q` [rad] and `dq` [rad/s].
    ///
    /// The encoder is at the rotor.
    #[inline(always)]
    pub fn encoder_reading(&self, joint: usize, q: T, dq: T) -> (T, T) {
        let (n, zero, [angle, speed]) = (&self.coefficients[joint], T::splat(0.0), &self.state.rotor);
        let q = zero.select_lt(n.gear, angle[joint], q);
        let dq = zero.select_lt(n.gear, speed[joint], dq);
        (q + n.encoder_offset + n.encoder_lead * dq, dq)
    }

    /// Returns the torque that the current sensors measure, mean over the last physics step [N·m].
    pub fn estimated_torque(&self) -> &J {
        &self.estimated_torque
    }

    /// Visits every value that differs between lanes, always in the same order.
    pub fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
        for coefficients in &mut self.coefficients {
            coefficients.visit(&mut visit);
        }
        let ActuatorState { commands, torque_history: torque, current, rotor } = &mut self.state;
        let values =
            commands.iter_mut().flatten().chain(torque).chain([current]).chain(rotor).chain([&mut self.derating]);
        values.flat_map(AsMut::as_mut).for_each(visit);
    }

    /// Updates derived state; call it after [`SimdActuators::visit`] has changed values.
    pub fn restored(&mut self) {
        self.update_active_effects();
    }
}

/// Returns the length of the command and torque history [actuator periods]: the longest delay, and two for interpolation.
fn history_len(actuator_dt: f64) -> usize {
    // 0.04 s are eight periods of 5 ms, whatever the rounding of the quotient.
    (ActuatorParams::MAX_DELAY / actuator_dt - 1e-6).ceil() as usize + 2
}
