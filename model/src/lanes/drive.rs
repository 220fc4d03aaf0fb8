//! From command to torque: the drives of robots in lanes, and friction and springs behind them.
//!
//! [`Drive::tick`] runs once a drive period on what the drive samples then; [`Drive::push`] once a physics step. Both
//! engines use them, so that an effect of reality has one law. What no robot of the lanes has costs one test a step.

use super::lane::{SimdFloat, exponential};
use crate::{Command, ActuatorParams, JointModel, PerJoint, RobotModel};

/// Drive periods that are remembered: the longest delay at 200 Hz, and the two that a fraction lies between.
const HISTORY_LEN: usize = 10;
/// Stiffness of a gear that has play and no stiffness of its own [N·m/rad].
const DEFAULT_GEAR_STIFFNESS: f64 = 2000.0;

/// Stiffness of a gear times the square of the physics step [kg·m²]: a calf of 0.006 kg·m² behind a stiffer one would be
/// thrown about, because it feels the gear once a step.
const MAX_GEAR_STIFFNESS_DT2: f64 = 0.006;
/// Steps of a rotor on an elastic gear in a physics step.
const GEAR_SUBSTEPS: usize = 8;

/// What the drives of robots in lanes are told for a drive period.
#[derive(Clone, Copy, Debug)]
pub struct SimdCommands<T> {
    /// Wanted position [rad].
    pub q: [T; 12],
    /// Wanted velocity [rad/s].
    pub dq: [T; 12],
    /// Feed-forward torque [N·m].
    pub tau_ff: [T; 12],
    /// [N·m/rad]
    pub kp: [T; 12],
    /// [N·m·s/rad]
    pub kd: [T; 12],
    /// Share of the torque that supply and heat leave.
    pub strength: [T; 12],
}

impl<T: SimdFloat> SimdCommands<T> {
    /// Of up to as many robots as there are lanes.
    pub fn new(commands: &[Command]) -> Self {
        let zero = [T::splat(0.0); 12];
        let mut this = Self { q: zero, dq: zero, tau_ff: zero, kp: zero, kd: zero, strength: zero };
        for (lane, command) in commands.iter().enumerate() {
            this.set(lane, command);
        }
        this
    }

    /// Sets what one robot is told.
    pub fn set(&mut self, lane: usize, command: &Command) {
        for joint in 0..12 {
            self.q[joint].set(lane, f64::from(command.q[joint]));
            self.dq[joint].set(lane, f64::from(command.dq[joint]));
            self.tau_ff[joint].set(lane, f64::from(command.tau_ff[joint]));
            self.kp[joint].set(lane, f64::from(command.kp[joint]));
            self.kd[joint].set(lane, f64::from(command.kd[joint]));
            self.strength[joint].set(lane, f64::from(command.derating_factor[joint]));
        }
    }
}

/// Which effects any robot of the lanes has.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools, reason = "each of them stands for itself")]
struct ActiveEffects {
    command_delay: bool,
    saturation: bool,
    torque_delay: bool,
    back_emf: bool,
    ripple: bool,
    elastic: bool,
    speed_friction: bool,
    spring: bool,
}

/// Defines the numbers of a joint, each with what it is of a [`JointModel`], a physics step and a drive period.
macro_rules! numbers {
    (|$joint:ident, $dt:ident, $drive_dt:ident| $($(#[$doc:meta])* $name:ident = $value:expr;)*) => {
        /// Numbers of a joint's drive, friction and spring.
        #[derive(Clone, Copy, Debug)]
        struct Numbers<T> {
            $($(#[$doc])* $name: T,)*
        }

        impl<T: Lane> Numbers<T> {
            fn splat($joint: &JointModel, $dt: f64, $drive_dt: f64) -> Self {
                Self { $($name: T::splat($value),)* }
            }

            fn set(&mut self, lane: usize, $joint: &JointModel, $dt: f64, $drive_dt: f64) {
                $(self.$name.set(lane, $value);)*
            }

            fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
                $(visit(&mut self.$name);)*
            }
        }
    };
}

numbers! { |joint, dt, drive_dt|
    torque_limit = joint.torque_limit;
    encoder_offset = joint.actuator.encoder_offset;
    /// In drive periods.
    command_delay = joint.actuator.command_delay / drive_dt;
    /// One over κ; 0 for none.
    saturation = 1.0 / joint.actuator.saturation;
    /// In drive periods.
    torque_delay = joint.actuator.torque_delay / drive_dt;
    /// One over the no-load speed; 0 for none.
    back_emf = 1.0 / joint.actuator.no_load_speed;
    /// Share of the way to its input that the torque goes in a physics step.
    lag = if joint.actuator.torque_time_constant > 0.0 { 1.0 - (-dt / joint.actuator.torque_time_constant).exp() } else { 1.0 };
    /// Mean over the step of what is left of its distance from its input.
    lag_mean = if joint.actuator.torque_time_constant > 0.0 { joint.actuator.torque_time_constant / dt * (1.0 - (-dt / joint.actuator.torque_time_constant).exp()) } else { 0.0 };
    gain = joint.actuator.gain;
    ripple_amplitude = joint.actuator.ripple.amplitude;
    ripple_cycles = joint.actuator.ripple.cycles;
    ripple_phase = joint.actuator.ripple.phase;
    half_gap = 0.5 * joint.actuator.backlash;
    /// Of the gear beyond its play [N·m/rad]; 0 where it is rigid.
    gear = gear_stiffness(&joint.actuator).min(MAX_GEAR_STIFFNESS_DT2 / (dt * dt));
    /// Inertia of a rotor on an elastic gear [kg·m²].
    rotor = joint.armature;
    viscous = joint.viscous_friction;
    coulomb = joint.coulomb_friction;
    breakaway = joint.stribeck_friction.breakaway_torque;
    /// One over the speed at which the breakaway fades [s/rad].
    fading = 1.0 / joint.stribeck_friction.stribeck_velocity;
    load = joint.load_friction;
    spring = joint.spring.stiffness;
    spring_at_zero = joint.spring.torque_offset;
}

/// Stiffness of the gear [N·m/rad]; 0 where rotor and link move as one.
fn gear_stiffness(drive: &ActuatorParams) -> f64 {
    if drive.gear_stiffness.is_finite() {
        drive.gear_stiffness
    } else if drive.backlash > 0.0 {
        DEFAULT_GEAR_STIFFNESS
    } else {
        0.0
    }
}

/// What the drives remember.
#[derive(Clone, Debug)]
struct ActuatorState<T> {
    /// Position, velocity and feed-forward torque of the last commands, newest first.
    commands: [[[T; 12]; 3]; HISTORY_LEN],
    /// Torque that the loop asked for in the last drive periods, newest first [N·m].
    torque_history: [[T; 12]; HISTORY_LEN],
    /// Behind the bandwidth: what the motor's current shows [N·m].
    current: [T; 12],
    /// Where the rotor of an elastic gear is [rad], and how fast [rad/s].
    rotor: [[T; 12]; 2],
}

/// The drives of robots in lanes.
#[derive(Clone, Debug)]
pub struct SimdActuators<T> {
    numbers: [Numbers<T>; 12],
    memory: ActuatorState<T>,
    /// Mean over the last physics step of what the motor's current shows [N·m].
    shown: [T; 12],
    uses: ActiveEffects,
    /// One physics step, in drive periods.
    step_fraction: T,
    /// One physics step [s].
    dt: f64,
    drive_dt: f64,
}

/// What acts at the joints in one physics step.
#[derive(Clone, Copy, Debug)]
pub struct JointForces<T> {
    /// Torque [N·m].
    pub tau: [T; 12],
    /// Viscous friction [N·m·s/rad].
    pub damping: [T; 12],
    /// Largest torque of the dry friction [N·m].
    pub dry_friction: [T; 12],
}

impl<T: SimdFloat> SimdActuators<T> {
    /// The drives of `robot` in every lane, without torque, for physics steps of `dt` [s].
    pub fn new(robot: &RobotModel, dt: f64) -> Self {
        let (zero, drive_dt) = ([T::splat(0.0); 12], robot.control.actuator_dt());
        let numbers = robot.joints.map(|joint| Numbers::splat(&joint, dt, drive_dt));
        let memory =
            ActuatorState { commands: [[zero; 3]; HISTORY_LEN], torque_history: [zero; HISTORY_LEN], current: zero, rotor: [zero; 2] };
        Self { numbers, memory, shown: zero, uses: ActiveEffects::default(), step_fraction: T::splat(dt / drive_dt), dt, drive_dt }
    }

    /// Puts the drives of `robot`, with its joints at `q` [rad] and `dq` [rad/s], into one lane; they have no torque yet.
    ///
    /// Returns the rotor inertia that moves with each link [kg·m²]: none of a rotor behind an elastic gear.
    pub fn set(&mut self, lane: usize, robot: &RobotModel, q: &PerJoint, dq: &PerJoint) -> [f64; 12] {
        let mut on_link = [0.0; 12];
        for (index, joint) in robot.joints.iter().enumerate() {
            on_link[index] = if gear_stiffness(&joint.actuator) > 0.0 { 0.0 } else { joint.armature };
            self.numbers[index].set(lane, joint, self.dt, self.drive_dt);
            let memory = &mut self.memory;
            // Before the first command a robot held still where it was put.
            for command in &mut memory.commands {
                command[0][index].set(lane, f64::from(q[index]) + joint.actuator.encoder_offset);
                command[1][index].set(lane, 0.0);
                command[2][index].set(lane, 0.0);
            }
            for asked in &mut memory.torque_history {
                asked[index].set(lane, 0.0);
            }
            memory.current[index].set(lane, 0.0);
            memory.rotor[0][index].set(lane, f64::from(q[index]));
            memory.rotor[1][index].set(lane, f64::from(dq[index]));
        }
        self.update_active_effects();
        on_link
    }

    /// Whether what happened before a start matters to any drive of the lanes.
    pub fn has_memory(&self) -> bool {
        let is_late = |n: &Numbers<T>| n.lag.any_lt(T::splat(1.0));
        self.uses.command_delay || self.uses.torque_delay || self.numbers.iter().any(is_late)
    }

    /// A drive period of `steps` physics steps that is over, with what the encoders showed at its start: it leaves what the
    /// drives remember of it, and nothing moves.
    pub fn replay_history(&mut self, commands: &SimdCommands<T>, q: &[T; 12], dq: &[T; 12], steps: usize) {
        let rotors = self.memory.rotor;
        let link: [T; 12] = std::array::from_fn(|joint| q[joint] - self.numbers[joint].encoder_offset);
        self.memory.rotor = [link, *dq];
        self.update_command(commands, &link, dq);
        for index in 0..steps {
            self.step(index, &link, dq);
            self.memory.rotor = [link, *dq];
        }
        self.memory.rotor = rotors;
    }

    fn update_active_effects(&mut self) {
        let (zero, mut uses) = (T::splat(0.0), ActiveEffects::default());
        for n in &self.numbers {
            uses.command_delay |= zero.any_lt(n.command_delay);
            uses.saturation |= zero.any_lt(n.saturation);
            uses.torque_delay |= zero.any_lt(n.torque_delay);
            uses.back_emf |= zero.any_lt(n.back_emf);
            uses.ripple |= zero.any_lt(n.ripple_amplitude);
            uses.elastic |= zero.any_lt(n.gear);
            uses.speed_friction |= zero.any_lt(n.breakaway) || zero.any_lt(n.load);
            uses.spring |= zero.any_lt(n.spring);
        }
        self.uses = uses;
    }

    /// What drive and log see of a joint whose link is at `q` [rad] with `dq` [rad/s]. The encoder sits at the rotor.
    #[inline(always)]
    pub fn encoder_reading(&self, joint: usize, q: T, dq: T) -> (T, T) {
        let (n, zero, [angle, speed]) = (&self.numbers[joint], T::splat(0.0), &self.memory.rotor);
        let q = zero.select_lt(n.gear, angle[joint], q);
        (q + n.encoder_offset, zero.select_lt(n.gear, speed[joint], dq))
    }

    /// What a sensor of the motors' current shows, mean over the last physics step [N·m].
    pub fn estimated_torque(&self) -> &[T; 12] {
        &self.shown
    }

    /// The loop closes: commands and sampled state become the torque of the coming drive period.
    #[inline(always)]
    pub fn update_command(&mut self, commands: &SimdCommands<T>, q: &[T; 12], dq: &[T; 12]) {
        let now =
            if self.uses.command_delay { self.delayed(commands) } else { [commands.q, commands.dq, commands.tau_ff] };
        let mut asked = [T::splat(0.0); 12];
        for joint in 0..12 {
            let n = &self.numbers[joint];
            let (kp, kd) = (commands.kp[joint], commands.kd[joint]);
            let (seen_q, seen_dq) = self.encoder_reading(joint, q[joint], dq[joint]);
            let mut tau = now[2][joint] + (kp * (now[0][joint] - seen_q) + kd * (now[1][joint] - seen_dq));
            if self.uses.saturation {
                tau = saturated(tau, n.saturation);
            }
            // A torque that is not a number must not become the limit: it is to be seen.
            let limit = n.torque_limit;
            asked[joint] = limit.min((tau * commands.strength[joint]).max(-limit));
        }
        self.set_torque(asked);
    }

    /// A torque from outside for the coming drive period [N·m], in place of [`Drive::tick`].
    #[inline(always)]
    pub fn set_torque(&mut self, asked: [T; 12]) {
        if self.uses.torque_delay {
            self.memory.torque_history.copy_within(0..HISTORY_LEN - 1, 1);
        }
        self.memory.torque_history[0] = asked;
    }

    /// Remembers the commands; those that arrive now.
    #[inline(always)]
    fn delayed(&mut self, commands: &SimdCommands<T>) -> [[T; 12]; 3] {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        self.memory.commands.copy_within(0..HISTORY_LEN - 1, 1);
        self.memory.commands[0] = [commands.q, commands.dq, commands.tau_ff];
        let mut arrived = [[zero; 12]; 3];
        for (age, command) in self.memory.commands.iter().enumerate() {
            for joint in 0..12 {
                // A fraction of a period lies between two commands.
                let off = (self.numbers[joint].command_delay - T::splat(age as f64)).abs();
                let weight = (one - off).max(zero);
                for quantity in 0..3 {
                    arrived[quantity][joint] += weight * command[quantity][joint];
                }
            }
        }
        arrived
    }

    /// What acts in physics step `index` of the drive period, with the joints at `q` and `dq`.
    #[inline(always)]
    pub fn step(&mut self, index: usize, q: &[T; 12], dq: &[T; 12]) -> JointForces<T> {
        let uses = self.uses;
        let input = if uses.torque_delay { self.delayed_torque(index) } else { self.memory.torque_history[0] };
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let mut forces = JointForces { tau: [zero; 12], damping: [zero; 12], dry_friction: [zero; 12] };
        for joint in 0..12 {
            let n = &self.numbers[joint];
            // Back-EMF and ripple are the motor's: of the rotor, where it moves on its own.
            let rotor_q = zero.select_lt(n.gear, self.memory.rotor[0][joint], q[joint]);
            let rotor_dq = zero.select_lt(n.gear, self.memory.rotor[1][joint], dq[joint]);
            let mut tau = input[joint];
            if uses.back_emf {
                let (limit, share) = (n.torque_limit, rotor_dq * n.back_emf);
                let forth = limit * (one - share).max(zero).min(one);
                let back = limit * (one + share).max(zero).min(one);
                tau = forth.min(tau.max(-back));
            }
            let (current, input) = (&mut self.memory.current[joint], tau);
            self.shown[joint] = input + n.lag_mean * (*current - input);
            *current += n.lag * (input - *current);
            tau = n.gain * self.shown[joint];
            if uses.ripple {
                let (sin, _) = (n.ripple_cycles * rotor_q + n.ripple_phase).sin_cos();
                tau += n.ripple_amplitude * sin;
            }
            (forces.damping[joint], forces.dry_friction[joint]) = (n.viscous, n.coulomb);
            if uses.speed_friction {
                let speed = dq[joint] * n.fading;
                forces.dry_friction[joint] += n.breakaway * exponential(-(speed * speed)) + n.load * tau.abs();
            }
            forces.tau[joint] = tau;
        }
        if uses.elastic {
            self.integrate_gear(&mut forces.tau, q, dq);
        }
        if uses.spring {
            for joint in 0..12 {
                let n = &self.numbers[joint];
                forces.tau[joint] += n.spring_at_zero - n.spring * q[joint];
            }
        }
        forces
    }

    /// The mean of the delayed torque over physics step `index`.
    #[inline(always)]
    fn delayed_torque(&self, index: usize) -> [T; 12] {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let start = self.step_fraction * T::splat(index as f64);
        let mut late = [zero; 12];
        for joint in 0..12 {
            let from = start - self.numbers[joint].torque_delay;
            let to = from + self.step_fraction;
            for (age, asked) in self.memory.torque_history.iter().enumerate() {
                let period = T::splat(-(age as f64));
                let shared = (to.min(period + one) - from.max(period)).max(zero);
                late[joint] += shared / self.step_fraction * asked[joint];
            }
            // Exactly as without neighbours that are late.
            late[joint] = zero.select_lt(self.numbers[joint].torque_delay, late[joint], self.memory.torque_history[0][joint]);
        }
        late
    }

    /// Moves the rotors behind elastic gears, in finer steps while the links keep their speeds; the mean of what reaches
    /// the links replaces `tau`.
    #[inline(always)]
    fn integrate_gear(&mut self, tau: &mut [T; 12], q: &[T; 12], dq: &[T; 12]) {
        let (zero, dt) = (T::splat(0.0), T::splat(self.dt / GEAR_SUBSTEPS as f64));
        let [angle, speed] = &mut self.memory.rotor;
        for joint in 0..12 {
            let Numbers { half_gap, gear: stiffness, rotor, .. } = self.numbers[joint];
            let (mut link, mut mean) = (q[joint], zero);
            for _ in 0..GEAR_SUBSTEPS {
                let twist = angle[joint] - link;
                let carried = stiffness * ((twist - half_gap).max(zero) + (twist + half_gap).min(zero));
                speed[joint] += dt * (tau[joint] - carried) / rotor;
                angle[joint] += dt * speed[joint];
                link += dt * dq[joint];
                mean += carried * T::splat(1.0 / GEAR_SUBSTEPS as f64);
            }
            tau[joint] = zero.select_lt(stiffness, mean, tau[joint]);
        }
    }

    /// Visits every number that differs between robots, always in the same order.
    pub fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
        for numbers in &mut self.numbers {
            numbers.visit(&mut visit);
        }
        let ActuatorState { commands, torque_history: asked, current, rotor } = &mut self.memory;
        commands.iter_mut().flatten().chain(asked).chain([current]).chain(rotor).flatten().for_each(visit);
    }

    /// After [`Drive::visit`] has written.
    pub fn restored(&mut self) {
        self.update_active_effects();
    }
}

/// `κ · tanh(τ / κ)`, given one over κ.
#[inline(always)]
fn saturated<T: SimdFloat>(tau: T, inverse: T) -> T {
    let one = T::splat(1.0);
    // tanh x = sign(x) (1 − e) / (1 + e) with e = exp(−2 |x|).
    let e = exponential(-((tau * inverse).abs() * T::splat(2.0)));
    let size = (one - e) / ((one + e) * inverse.max(T::splat(1e-9)));
    let limited = tau.select_lt(T::splat(0.0), -size, size);
    // Without saturation, and where tanh cannot be told from its argument.
    inverse.select_lt(T::splat(1e-9), tau, limited)
}
