//! Coefficients of the laws of actuators and joints, and the effects that they activate.

use twinstep_model::{ActuatorParams, JointModel};
use twinstep_simd::SimdFloat;

/// Stiffness of a gear with backlash for which the model gives no stiffness [N·m/rad].
const DEFAULT_GEAR_STIFFNESS: f64 = 2000.0;

/// Limit of gear stiffness times the square of the physics step [kg·m²]. The gear torque on a link is constant during a
/// step, so a calf of 0.006 kg·m² would be unstable with a stiffer gear.
const MAX_GEAR_STIFFNESS_DT2: f64 = 0.006;

/// Defines the coefficients of a joint as functions of a [`JointModel`], the physics step and the actuator period.
macro_rules! coefficients {
    (|$joint:ident, $dt:ident, $actuator_dt:ident| $($(#[$doc:meta])* $name:ident = $value:expr;)*) => {
        /// Coefficients of a joint's actuator, friction and spring.
        #[derive(Clone, Copy, Debug)]
        pub struct Coefficients<T> {
            $($(#[$doc])* pub $name: T,)*
        }

        impl<T: SimdFloat> Coefficients<T> {
            pub fn splat($joint: &JointModel, $dt: f64, $actuator_dt: f64) -> Self {
                Self { $($name: T::splat($value),)* }
            }

            pub fn set(&mut self, lane: usize, $joint: &JointModel, $dt: f64, $actuator_dt: f64) {
                $(self.$name.set(lane, $value);)*
            }

            pub fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
                $(visit(&mut self.$name);)*
            }
        }
    };
}

coefficients! { |joint, dt, actuator_dt|
    torque_limit = joint.torque_limit;
    encoder_offset = joint.actuator.encoder_offset;
    encoder_lead = joint.actuator.encoder_lead;
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

/// Returns the stiffness of the gear [N·m/rad]; 0 if rotor and link move together.
pub fn gear_stiffness(actuator: &ActuatorParams) -> f64 {
    if actuator.gear_stiffness.is_finite() {
        actuator.gear_stiffness
    } else if actuator.backlash > 0.0 {
        DEFAULT_GEAR_STIFFNESS
    } else {
        0.0
    }
}

/// Effects that at least one robot in the batch has.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools, reason = "the flags are independent")]
pub struct ActiveEffects {
    pub command_delay: bool,
    pub pd_gain: bool,
    pub saturation: bool,
    pub torque_delay: bool,
    pub back_emf: bool,
    pub dead_zone: bool,
    pub ripple: bool,
    pub elastic: bool,
    pub speed_friction: bool,
    pub spring: bool,
}

impl ActiveEffects {
    /// Returns the effects that one of the joints has in at least one lane.
    pub fn of<T: SimdFloat>(coefficients: &[Coefficients<T>]) -> Self {
        let (zero, one, mut active) = (T::splat(0.0), T::splat(1.0), Self::default());
        for n in coefficients {
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
        active
    }
}
