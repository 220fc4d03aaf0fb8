//! Actuators of a batch of robots, one per SIMD lane: torque from commands, and friction and springs at the joints.
//!
//! [`SimdActuators::update_command`] runs once per actuator period on the sampled state; [`SimdActuators::step`] runs
//! once per physics step. Both engines use this code. An effect that no robot in the batch has costs one branch per
//! step.

use crate::{ActuatorParams, Command, JointModel, PerJoint, RobotModel};
use twinstep_simd::{SimdFloat, exponential};

/// Stiffness of a gear with backlash for which the model gives no stiffness [N·m/rad].
const DEFAULT_GEAR_STIFFNESS: f64 = 2000.0;

/// Limit of gear stiffness times the square of the physics step [kg·m²]. The gear torque on a link is constant during a
/// step, so a calf of 0.006 kg·m² would be unstable with a stiffer gear.
const MAX_GEAR_STIFFNESS_DT2: f64 = 0.006;
/// Integration steps of a rotor with an elastic gear per physics step.
const GEAR_SUBSTEPS: usize = 8;

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

/// Effects that at least one robot in the batch has.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools, reason = "the flags are independent")]
struct ActiveEffects {
    command_delay: bool,
    pd_gain: bool,
    saturation: bool,
    torque_delay: bool,
    back_emf: bool,
    dead_zone: bool,
    ripple: bool,
    elastic: bool,
    speed_friction: bool,
    spring: bool,
}

/// Defines the coefficients of a joint as functions of a [`JointModel`], the physics step and the actuator period.
macro_rules! coefficients {
    (|$joint:ident, $dt:ident, $actuator_dt:ident| $($(#[$doc:meta])* $name:ident = $value:expr;)*) => {
        /// Coefficients of a joint's actuator, friction and spring.
        #[derive(Clone, Copy, Debug)]
        struct Coefficients<T> {
            $($(#[$doc])* $name: T,)*
        }

        impl<T: SimdFloat> Coefficients<T> {
            fn splat($joint: &JointModel, $dt: f64, $actuator_dt: f64) -> Self {
                Self { $($name: T::splat($value),)* }
            }

            fn set(&mut self, lane: usize, $joint: &JointModel, $dt: f64, $actuator_dt: f64) {
                $(self.$name.set(lane, $value);)*
            }

            fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
                $(visit(&mut self.$name);)*
            }
        }
    };
}

coefficients! { |joint, dt, actuator_dt|
    torque_limit = joint.torque_limit;
    encoder_offset = joint.actuator.encoder_offset;
    /// Command delay [actuator periods].
    command_delay = joint.actuator.command_delay / actuator_dt;
    kp_scale = joint.actuator.kp_scale;
    kd_scale = joint.actuator.kd_scale;
    /// 1 / κ [1/(N·m)]; 0 for no saturation.
    saturation = 1.0 / joint.actuator.saturation;
    /// Torque delay [actuator periods].
    torque_delay = joint.actuator.torque_delay / actuator_dt;
    /// 1 / no-load speed [s/rad]; 0 for no limit.
    back_emf = 1.0 / joint.actuator.no_load_speed;
    /// Half width of the torque dead zone [N·m].
    dead_zone = joint.actuator.dead_zone;
    /// Fraction of its distance to the input that the lagged torque covers in a physics step.
    lag = if joint.actuator.torque_time_constant > 0.0 { 1.0 - (-dt / joint.actuator.torque_time_constant).exp() } else { 1.0 };
    /// Mean over a physics step of the remaining distance, divided by the distance at the start of the step.
    lag_mean = if joint.actuator.torque_time_constant > 0.0 { joint.actuator.torque_time_constant / dt * (1.0 - (-dt / joint.actuator.torque_time_constant).exp()) } else { 0.0 };
    gain = joint.actuator.gain;
    ripple_amplitude = joint.actuator.ripple.amplitude;
    ripple_cycles = joint.actuator.ripple.cycles;
    ripple_phase = joint.actuator.ripple.phase;
    half_backlash = 0.5 * joint.actuator.backlash;
    /// Gear stiffness outside the backlash [N·m/rad]; 0 for a rigid gear.
    gear = gear_stiffness(&joint.actuator).min(MAX_GEAR_STIFFNESS_DT2 / (dt * dt));
    /// Inertia of a rotor with an elastic gear [kg·m²].
    rotor = joint.armature;
    viscous = joint.viscous_friction;
    coulomb = joint.coulomb_friction;
    breakaway = joint.stribeck_friction.breakaway_torque;
    /// 1 / Stribeck velocity [s/rad].
    inv_stribeck_velocity = 1.0 / joint.stribeck_friction.stribeck_velocity;
    load = joint.load_friction;
    spring = joint.spring.stiffness;
    spring_offset = joint.spring.torque_offset;
}

/// Returns the length of the command and torque history [actuator periods]: the longest delay, and two for interpolation.
fn history_len(actuator_dt: f64) -> usize {
    // 0.04 s are eight periods of 5 ms, whatever the rounding of the quotient.
    (ActuatorParams::MAX_DELAY / actuator_dt - 1e-6).ceil() as usize + 2
}

/// Returns the stiffness of the gear [N·m/rad]; 0 if rotor and link move together.
fn gear_stiffness(actuator: &ActuatorParams) -> f64 {
    if actuator.gear_stiffness.is_finite() {
        actuator.gear_stiffness
    } else if actuator.backlash > 0.0 {
        DEFAULT_GEAR_STIFFNESS
    } else {
        0.0
    }
}

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
    active: ActiveEffects,
    /// Physics step [actuator periods].
    step_fraction: T,
    /// Physics step [s].
    dt: f64,
    actuator_dt: f64,
}

/// Torque and friction at the joints in one physics step.
#[derive(Clone, Copy, Debug)]
pub struct JointForces<T> {
    /// Torque [N·m].
    pub tau: [T; 12],
    /// Coefficient of viscous friction [N·m·s/rad].
    pub damping: [T; 12],
    /// Maximum torque of dry friction [N·m].
    pub dry_friction: [T; 12],
}

impl<T: SimdFloat> SimdActuators<T> {
    /// Creates the actuators of `robot` in every lane, with zero torque, for physics steps of `dt` [s].
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
            active: ActiveEffects::default(),
            step_fraction: T::splat(dt / actuator_dt),
            dt,
            actuator_dt,
        }
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
                command[0][index].set(lane, f64::from(q[index]) + joint.actuator.encoder_offset);
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
        let link: [T; 12] = std::array::from_fn(|joint| q[joint] - self.coefficients[joint].encoder_offset);
        self.state.rotor = [link, *dq];
        self.update_command(commands, &link, dq);
        for index in 0..steps {
            self.step(index, &link, dq);
            self.state.rotor = [link, *dq];
        }
        self.state.rotor = rotors;
    }

    fn update_active_effects(&mut self) {
        let (zero, one, mut active) = (T::splat(0.0), T::splat(1.0), ActiveEffects::default());
        for n in &self.coefficients {
            active.command_delay |= zero.any_lt(n.command_delay);
            active.pd_gain |= [n.kp_scale, n.kd_scale].iter().any(|scale| scale.any_lt(one) || one.any_lt(*scale));
            active.saturation |= zero.any_lt(n.saturation);
            active.torque_delay |= zero.any_lt(n.torque_delay);
            active.back_emf |= zero.any_lt(n.back_emf);
            active.dead_zone |= zero.any_lt(n.dead_zone);
            active.ripple |= zero.any_lt(n.ripple_amplitude);
            active.elastic |= zero.any_lt(n.gear);
            active.speed_friction |= zero.any_lt(n.breakaway) || zero.any_lt(n.load);
            active.spring |= zero.any_lt(n.spring);
        }
        self.active = active;
    }

    /// Returns the encoder reading [rad], [rad/s] of a joint whose link is at `q` [rad] and `dq` [rad/s].
    ///
    /// The encoder is at the rotor.
    #[inline(always)]
    pub fn encoder_reading(&self, joint: usize, q: T, dq: T) -> (T, T) {
        let (n, zero, [angle, speed]) = (&self.coefficients[joint], T::splat(0.0), &self.state.rotor);
        let q = zero.select_lt(n.gear, angle[joint], q);
        (q + n.encoder_offset, zero.select_lt(n.gear, speed[joint], dq))
    }

    /// Returns the torque that the current sensors measure, mean over the last physics step [N·m].
    pub fn estimated_torque(&self) -> &[T; 12] {
        &self.estimated_torque
    }

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

    /// Advances the actuators by physics step `index` of the actuator period and returns torque and friction.
    ///
    /// `q` [rad] and `dq` [rad/s] are the joint positions and velocities.
    #[inline(always)]
    pub fn step(&mut self, index: usize, q: &[T; 12], dq: &[T; 12]) -> JointForces<T> {
        let active = self.active;
        let input = if active.torque_delay { self.delayed_torque(index) } else { self.state.torque_history[0] };
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let mut forces = JointForces { tau: [zero; 12], damping: [zero; 12], dry_friction: [zero; 12] };
        for joint in 0..12 {
            let n = &self.coefficients[joint];
            // Back-EMF and ripple depend on the rotor, whose motion differs from the link's if the gear is elastic.
            let rotor_q = zero.select_lt(n.gear, self.state.rotor[0][joint], q[joint]);
            let rotor_dq = zero.select_lt(n.gear, self.state.rotor[1][joint], dq[joint]);
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
            tau = n.gain * self.estimated_torque[joint];
            if active.ripple {
                let (sin, _) = (n.ripple_cycles * rotor_q + n.ripple_phase).sin_cos();
                tau += n.ripple_amplitude * sin;
            }
            (forces.damping[joint], forces.dry_friction[joint]) = (n.viscous, n.coulomb);
            if active.speed_friction {
                let speed = dq[joint] * n.inv_stribeck_velocity;
                forces.dry_friction[joint] += n.breakaway * exponential(-(speed * speed)) + n.load * tau.abs();
            }
            forces.tau[joint] = tau;
        }
        if active.elastic {
            self.integrate_gear(&mut forces.tau, q, dq);
        }
        if active.spring {
            for joint in 0..12 {
                let n = &self.coefficients[joint];
                forces.tau[joint] += n.spring_offset - n.spring * q[joint];
            }
        }
        forces
    }

    /// Returns the mean of the delayed torque over physics step `index` [N·m].
    #[inline(always)]
    fn delayed_torque(&self, index: usize) -> [T; 12] {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let start = self.step_fraction * T::splat(index as f64);
        let mut delayed = [zero; 12];
        for joint in 0..12 {
            let from = start - self.coefficients[joint].torque_delay;
            let to = from + self.step_fraction;
            for (age, torque) in self.state.torque_history.iter().enumerate() {
                let period = T::splat(-(age as f64));
                let shared = (to.min(period + one) - from.max(period)).max(zero);
                delayed[joint] += shared / self.step_fraction * torque[joint];
            }
            // Without delay the exact value, so that the result does not depend on the other lanes.
            delayed[joint] = zero.select_lt(
                self.coefficients[joint].torque_delay,
                delayed[joint],
                self.state.torque_history[0][joint],
            );
        }
        delayed
    }

    /// Integrates the rotors of elastic gears in substeps with constant link velocities.
    ///
    /// Replaces `tau` by the mean torque that the gear transmits to the link [N·m].
    #[inline(always)]
    fn integrate_gear(&mut self, tau: &mut [T; 12], q: &[T; 12], dq: &[T; 12]) {
        let (zero, dt) = (T::splat(0.0), T::splat(self.dt / GEAR_SUBSTEPS as f64));
        let [angle, speed] = &mut self.state.rotor;
        for joint in 0..12 {
            let Coefficients { half_backlash, gear: stiffness, rotor, .. } = self.coefficients[joint];
            let (mut link, mut mean) = (q[joint], zero);
            for _ in 0..GEAR_SUBSTEPS {
                let twist = angle[joint] - link;
                let transmitted = stiffness * ((twist - half_backlash).max(zero) + (twist + half_backlash).min(zero));
                speed[joint] += dt * (tau[joint] - transmitted) / rotor;
                angle[joint] += dt * speed[joint];
                link += dt * dq[joint];
                mean += transmitted * T::splat(1.0 / GEAR_SUBSTEPS as f64);
            }
            tau[joint] = zero.select_lt(stiffness, mean, tau[joint]);
        }
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
