//! Actuators of a plant that shares no code with the model: the laws of the catalogue, written once more with `f64` and
//! small time steps.

use std::collections::VecDeque;

use twinstep_model::{ActuatorMode, ActuatorTap, Command, JointModel, NUM_JOINTS, RobotModel};

/// Stiffness of a gear with backlash for which the robot gives none [N·m/rad].
const RIGID_GEAR: f64 = 2000.0;
/// Steps of a rotor with an elastic gear per step of the plant.
const ROTOR_STEPS: usize = 20;
/// Speed at which friction that depends on speed or load has its sign [rad/s].
const REVERSAL_SPEED: f64 = 0.05;

/// Values of all joints.
pub type Joints = [f64; NUM_JOINTS];

/// Torques of a step of the plant [N·m].
pub struct PlantTorques {
    /// Torque that the current sensors measure.
    pub sensed: Joints,
    /// Torque on the links, without viscous and Coulomb friction.
    pub applied: Joints,
}

/// Rotor of an elastic gear.
#[derive(Clone, Copy, Default)]
struct Rotor {
    q: f64,
    dq: f64,
}

/// Actuators of one robot.
pub struct PlantActuator {
    joints: [JointModel; NUM_JOINTS],
    /// Steps of the plant per actuator period.
    steps: usize,
    /// Time step [s].
    dt: f64,
    /// Commands of the last actuator periods, newest first.
    commands: VecDeque<Command>,
    /// Torque of the PD loop in the last steps, newest first [N·m].
    torques: VecDeque<Joints>,
    /// Torque of the PD loop in this actuator period [N·m].
    wanted: Joints,
    /// Torque after the lag [N·m].
    current: Joints,
    /// Torque that is added at a tap in this actuator period [N·m].
    residual: Option<(ActuatorTap, Joints)>,
    rotors: [Rotor; NUM_JOINTS],
    /// Factor on the torque for supply voltage and motor temperature.
    pub derating: Joints,
}

impl PlantActuator {
    /// Creates the actuators of `robot` at rest at `q` [rad], with `steps` steps per actuator period.
    pub fn new(robot: &RobotModel, steps: usize, q: &Joints) -> Self {
        let rotors = q.map(|q| Rotor { q, dq: 0.0 });
        Self {
            joints: robot.joints,
            steps,
            dt: robot.control.actuator_dt() / steps as f64,
            commands: VecDeque::new(),
            torques: VecDeque::new(),
            wanted: [0.0; NUM_JOINTS],
            current: [0.0; NUM_JOINTS],
            residual: None,
            rotors,
            derating: [1.0; NUM_JOINTS],
        }
    }

    /// Returns true if rotor and link of a joint move separately.
    pub fn has_rotor(joint: &JointModel) -> bool {
        joint.actuator.gear_stiffness.is_finite() || joint.actuator.backlash > 0.0
    }

    /// Returns the reading of the encoder at the rotor [rad], [rad/s] of a joint whose link is at `q` and `dq`.
    pub fn reading(&self, joint: usize, q: f64, dq: f64) -> (f64, f64) {
        let model = &self.joints[joint];
        let rotor = if Self::has_rotor(model) { self.rotors[joint] } else { Rotor { q, dq } };
        (rotor.q + model.actuator.encoder_error(rotor.dq), rotor.dq)
    }

    /// Samples the links at `q` [rad] and `dq` [rad/s] and computes the torque of the PD loop for an actuator period.
    pub fn sample(&mut self, command: &Command, q: &Joints, dq: &Joints) {
        self.commands.push_front(*command);
        self.commands.truncate(64);
        for joint in 0..NUM_JOINTS {
            let actuator = &self.joints[joint].actuator;
            let age = actuator.command_delay / (self.dt * self.steps as f64);
            let delayed = |of: fn(&Command, usize) -> f32| {
                interpolated(&self.commands, age, |command| f64::from(of(command, joint)))
            };
            let (wanted_q, wanted_dq) = (delayed(|one, joint| one.q[joint]), delayed(|one, joint| one.dq[joint]));
            let (measured_q, measured_dq) = self.reading(joint, q[joint], dq[joint]);
            let kp = f64::from(command.kp[joint]) * actuator.kp_scale;
            let kd = f64::from(command.kd[joint]) * actuator.kd_scale;
            let mut torque = kp * (wanted_q - measured_q) + kd * (wanted_dq - measured_dq);
            torque += delayed(|one, joint| one.tau_ff[joint]);
            if actuator.saturation.is_finite() {
                torque = actuator.saturation * (torque / actuator.saturation).tanh();
            }
            let limit = self.joints[joint].torque_limit;
            self.wanted[joint] = (torque * self.derating[joint]).clamp(-limit, limit);
        }
    }

    /// Takes over the torques of an external actuator for an actuator period [N·m].
    pub fn set_external(&mut self, mode: ActuatorMode, tau: Joints) {
        match mode {
            ActuatorMode::Replace(_) => self.wanted = tau,
            ActuatorMode::AddAt(tap) => self.residual = Some((tap, tau)),
        }
    }

    /// Advances the actuators by a step in which the links move from `q` [rad] with `dq` [rad/s].
    pub fn step(&mut self, q: &Joints, dq: &Joints) -> PlantTorques {
        self.torques.push_front(self.wanted);
        self.torques.truncate(256);
        let mut torques = PlantTorques { sensed: [0.0; NUM_JOINTS], applied: [0.0; NUM_JOINTS] };
        for joint in 0..NUM_JOINTS {
            let model = self.joints[joint];
            let actuator = &model.actuator;
            let has_rotor = Self::has_rotor(&model);
            let rotor = if has_rotor { self.rotors[joint] } else { Rotor { q: q[joint], dq: dq[joint] } };
            let mut torque = interpolated(&self.torques, actuator.torque_delay / self.dt, |torques| torques[joint]);
            if actuator.no_load_speed.is_finite() {
                // Full torque against the motion, less along it.
                let share = (1.0 - torque.signum() * rotor.dq / actuator.no_load_speed).clamp(0.0, 1.0);
                torque = torque.clamp(-model.torque_limit * share, model.torque_limit * share);
            }
            if actuator.dead_zone > 0.0 {
                torque = torque.signum() * (torque.abs() - actuator.dead_zone).max(0.0);
            }
            let share = if actuator.torque_time_constant > 0.0 {
                1.0 - (-self.dt / actuator.torque_time_constant).exp()
            } else {
                1.0
            };
            self.current[joint] += share * (torque - self.current[joint]);
            let residual_at = |tap: ActuatorTap| match &self.residual {
                Some((at, residual)) if *at == tap => residual[joint],
                _ => 0.0,
            };
            let output_residual = residual_at(ActuatorTap::Output);
            torques.sensed[joint] = self.current[joint] + residual_at(ActuatorTap::Current);
            let ripple = actuator.ripple;
            let motor = actuator.gain * torques.sensed[joint]
                + ripple.amplitude * (ripple.cycles * rotor.q + ripple.phase).sin();
            let gear = if has_rotor { self.gear_torque(joint, motor, q[joint], dq[joint]) } else { motor };
            let stribeck = model.stribeck_friction;
            let slow = (dq[joint] / stribeck.stribeck_velocity).powi(2);
            let friction = stribeck.breakaway_torque * (-slow).exp() + model.load_friction * motor.abs();
            torques.applied[joint] = gear + output_residual - friction * (dq[joint] / REVERSAL_SPEED).tanh()
                + model.spring.torque_offset
                - model.spring.stiffness * q[joint];
        }
        torques
    }

    /// Advances a rotor by a step and returns the mean torque of the gear on the link [N·m].
    fn gear_torque(&mut self, joint: usize, motor: f64, q: f64, dq: f64) -> f64 {
        let model = &self.joints[joint];
        let stiffness = Some(model.actuator.gear_stiffness).filter(|one| one.is_finite()).unwrap_or(RIGID_GEAR);
        let (half, dt) = (0.5 * model.actuator.backlash, self.dt / ROTOR_STEPS as f64);
        let (rotor, mut sum) = (&mut self.rotors[joint], 0.0);
        for step in 0..ROTOR_STEPS {
            let twist = rotor.q - (q + dq * step as f64 * dt);
            let torque = stiffness * (twist.abs() - half).max(0.0) * twist.signum();
            rotor.dq += dt * (motor - torque) / model.armature;
            rotor.q += dt * rotor.dq;
            sum += torque;
        }
        sum / ROTOR_STEPS as f64
    }
}

/// Returns the value `age` entries ago, interpolated linearly. Before the first entry it is that of the first.
fn interpolated<T>(history: &VecDeque<T>, age: f64, of: impl Fn(&T) -> f64) -> f64 {
    let at = |index: usize| of(&history[index.min(history.len() - 1)]);
    let (index, part) = (age.floor() as usize, age.fract());
    (1.0 - part) * at(index) + part * at(index + 1)
}

#[cfg(test)]
mod tests {
    use twinstep_model::go2;

    use super::*;

    /// Returns the torques of a joint over 100 steps of 0.5 ms with constant wanted torque of 3 N·m and speed.
    fn run(change: impl Fn(&mut JointModel), dq: f64) -> Vec<[f64; 2]> {
        let mut robot = go2();
        robot.joints.iter_mut().for_each(change);
        robot.control.actuator_hz = 200.0;
        let (q, dq) = ([0.3; NUM_JOINTS], [dq; NUM_JOINTS]);
        let mut actuator = PlantActuator::new(&robot, 10, &q);
        let mut command = Command::hold([0.0; NUM_JOINTS], 0.0, 0.0);
        let mut torques = Vec::new();
        for period in 0..10 {
            command.tau_ff = [if period == 0 { 0.0 } else { 3.0 }; NUM_JOINTS];
            actuator.sample(&command, &q, &dq);
            for _ in 0..10 {
                let torque = actuator.step(&q, &dq);
                torques.push([torque.sensed[4], torque.applied[4]]);
            }
        }
        torques
    }

    #[test]
    fn delay_shifts_and_lag_smooths_the_torque() {
        // Wanted from step 10 on, that is, from 5 ms.
        let delayed = run(|joint| joint.actuator.torque_delay = 0.006, 0.0);
        assert_eq!((delayed[20][0], delayed[23][0]), (0.0, 3.0));
        let lagged = run(|joint| joint.actuator.torque_time_constant = 0.01, 0.0);
        assert!((lagged[29][0] / 3.0 - (1.0 - (-1.0_f64).exp())).abs() < 0.01, "{:?}", lagged[29]);
    }

    #[test]
    fn gain_and_load_friction_are_behind_the_current_sensor() {
        let [sensed, applied] = *run(|joint| joint.actuator.gain = 0.8, 0.0).last().expect("steps");
        assert!((sensed - 3.0).abs() < 1e-9 && (applied - 2.4).abs() < 1e-9);
        let [sensed, applied] = *run(|joint| joint.load_friction = 0.1, 2.0).last().expect("steps");
        assert!((sensed - 3.0).abs() < 1e-9 && (applied - 2.7).abs() < 1e-6);
    }

    #[test]
    fn torque_along_the_motion_falls_with_speed() {
        let limited = |joint: &mut JointModel| joint.actuator.no_load_speed = 20.0;
        let [along, _] = *run(limited, 19.0).last().expect("steps");
        let limit = go2().joints[4].torque_limit;
        assert!((along - (0.05 * limit).min(3.0)).abs() < 1e-9, "{along}");
        let [against, _] = *run(limited, -19.0).last().expect("steps");
        assert!((against - 3.0).abs() < 1e-9);
    }

    #[test]
    fn rotor_turns_within_the_backlash_before_the_gear_transmits() {
        let torques = run(|joint| joint.actuator.backlash = 0.02, 0.0);
        let first = torques.iter().position(|torque| torque[1] != 0.0).expect("the gear engages");
        assert!(first > 11, "{first}");
        let mean = torques[60..].iter().map(|torque| torque[1]).sum::<f64>() / 40.0;
        assert!((mean - 3.0).abs() < 2.0, "{mean}");
    }
}
