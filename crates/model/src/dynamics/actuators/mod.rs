//! Actuators of a batch of robots, one per SIMD lane: torque from commands, and friction and springs at the joints.
//!
//! [`SimdActuators::update_command`] runs once per actuator period on the sampled state; [`SimdActuators::step`] runs
//! once per physics step. Both engines use this code. An effect that no robot in the batch has costs one branch per
//! step.
//!
//! - [`commands`]: commands, one robot per lane.
//! - [`coefficients`]: numbers of the laws, computed from a [`crate::JointModel`].
//! - [`pd_loop`]: the laws that act once per actuator period.
//! - [`joint_forces`]: the laws that act once per physics step.

mod coefficients;
mod commands;
mod joint_forces;
mod pd_loop;

use crate::{ActuatorParams, ActuatorTap, PerJoint, RobotModel};
use twinstep_simd::SimdFloat;

use coefficients::{ActiveEffects, Coefficients, gear_stiffness};
pub use commands::SimdCommands;
pub use joint_forces::JointForces;

/// State of the actuators between physics steps.
#[derive(Clone, Debug)]
struct ActuatorState<T> {
    /// Position [rad], velocity [rad/s] and feed-forward torque [N·m] of the last commands, newest first.
    commands: Vec<[[T; 12]; 3]>,
    /// Torque of the PD loop in the last actuator periods, newest first [N·m].
    torque_history: Vec<[T; 12]>,
    /// Torque after the first-order lag, proportional to the motor current [N·m].
    current: [T; 12],
    /// Position [rad] and velocity [rad/s] of the rotor of an elastic gear.
    rotor: [[T; 12]; 2],
}

/// Actuators of a batch of robots, one per lane.
#[derive(Clone, Debug)]
pub struct SimdActuators<T> {
    coefficients: [Coefficients<T>; 12],
    state: ActuatorState<T>,
    /// Torque that the current sensor measures, mean over the last physics step [N·m].
    estimated_torque: [T; 12],
    /// Factor on the torque for supply voltage and motor temperature.
    derating: [T; 12],
    /// Torque that is added at a tap in the current actuator period [N·m].
    residual: Option<(ActuatorTap, [T; 12])>,
    active: ActiveEffects,
    /// Physics step [actuator periods].
    step_fraction: T,
    /// Physics step [s].
    dt: f64,
    /// Time from a sample to the link positions of [`SimdActuators::step`] after it [s].
    lead: f64,
    actuator_dt: f64,
}

impl<T: SimdFloat> SimdActuators<T> {
    /// Creates the actuators of `robot` in every lane, with zero torque, for physics steps of `dt` [s].
    ///
    /// Link positions of a step are those of its middle, half a step after a sample.
    pub fn new(robot: &RobotModel, dt: f64) -> Self {
        let (zero, actuator_dt) = ([T::splat(0.0); 12], robot.control.actuator_dt());
        let coefficients = robot.joints.map(|joint| Coefficients::splat(&joint, dt, actuator_dt));
        let length = history_len(actuator_dt);
        let state = ActuatorState {
            commands: vec![[zero; 3]; length],
            torque_history: vec![zero; length],
            current: zero,
            rotor: [zero; 2],
        };
        Self {
            coefficients,
            state,
            estimated_torque: zero,
            derating: [T::splat(1.0); 12],
            residual: None,
            active: ActiveEffects::default(),
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

    /// Resets the actuators of one lane to those of `robot`, with joints at `q` [rad] and `dq` [rad/s] and zero torque.
    ///
    /// Returns the rotor inertia that moves with each link [kg·m²]; 0 if the gear is elastic.
    pub fn set(&mut self, lane: usize, robot: &RobotModel, q: &PerJoint, dq: &PerJoint) -> [f64; 12] {
        let mut on_link = [0.0; 12];
        for (index, joint) in robot.joints.iter().enumerate() {
            on_link[index] = if gear_stiffness(&joint.actuator) > 0.0 { 0.0 } else { joint.armature };
            self.coefficients[index].set(lane, joint, self.dt, self.actuator_dt);
            let state = &mut self.state;
            // The command history is the initial position, so a delayed first command starts from rest.
            for command in &mut state.commands {
                command[0][index].set(lane, f64::from(q[index]) + joint.actuator.encoder_error(f64::from(dq[index])));
                command[1][index].set(lane, 0.0);
                command[2][index].set(lane, 0.0);
            }
            for torque in &mut state.torque_history {
                torque[index].set(lane, 0.0);
            }
            state.current[index].set(lane, 0.0);
            state.rotor[0][index].set(lane, f64::from(q[index]));
            state.rotor[1][index].set(lane, f64::from(dq[index]));
        }
        self.set_derating(lane, &[1.0; 12]);
        self.update_active_effects();
        on_link
    }

    /// Sets the factors on the torque of one lane for supply voltage and motor temperature. A reset sets them to 1.
    pub fn set_derating(&mut self, lane: usize, factors: &PerJoint) {
        for (derating, factor) in self.derating.iter_mut().zip(factors) {
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
    pub fn replay_history(&mut self, commands: &SimdCommands<T>, q: &[T; 12], dq: &[T; 12], steps: usize) {
        let rotors = self.state.rotor;
        let link: [T; 12] = std::array::from_fn(|joint| {
            let n = &self.coefficients[joint];
            q[joint] - n.encoder_offset - n.encoder_lead * dq[joint]
        });
        self.state.rotor = [link, *dq];
        self.update_command(commands, &link, dq);
        for index in 0..steps {
            self.step(index, &link, dq);
            self.state.rotor = [link, *dq];
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
    pub fn estimated_torque(&self) -> &[T; 12] {
        &self.estimated_torque
    }

    /// Visits every value that differs between lanes, always in the same order.
    pub fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
        for coefficients in &mut self.coefficients {
            coefficients.visit(&mut visit);
        }
        let ActuatorState { commands, torque_history: torque, current, rotor } = &mut self.state;
        commands.iter_mut().flatten().chain(torque).chain([current]).chain(rotor).flatten().for_each(&mut visit);
        self.derating.iter_mut().for_each(visit);
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
