//! Which motion shows an effect, and in which quantities.

use std::f64::consts::TAU;

use twinstep_effects::Effect;
use twinstep_model::{BaseMount, JointKind};

use super::quantity::PlotQuantity;

/// A motion that shows an effect, and the quantities in which it does.
pub struct EffectDemo {
    /// What the robot is told.
    pub motion: &'static DemoMotion,
    /// What is shown over time.
    pub over_time: PlotQuantity,
    /// What the law is about: x and y.
    pub law: [PlotQuantity; 2],
}

/// What all legs are told, as offsets from the default pose.
pub struct DemoMotion {
    /// In words.
    pub what: &'static str,
    /// Whether the base is fixed.
    pub base: BaseMount,
    /// Height of the lowest foot above the ground at the start [m], where the base is floating.
    pub clearance: f32,
    /// The pose of time 0 is held for so long before it [s].
    pub settle: f64,
    /// Its length [s].
    pub duration: f64,
    /// [N·m/rad]
    pub kp: f32,
    /// [N·m·s/rad]
    pub kd: f32,
    /// The joint of the front left leg that is shown.
    pub joint: JointKind,
    /// Offsets of hip, thigh and calf at a time [rad].
    pub target: fn(f64) -> [f64; 3],
    /// The battery's voltage at its start and end [V].
    pub voltage: [f64; 2],
    /// The motors' temperature at its start and end [°C].
    pub temperature: [f64; 2],
}

/// In the air, with the model's own gains, fully charged and cold.
const HELD: DemoMotion = DemoMotion {
    what: "",
    base: BaseMount::Fixed,
    clearance: 0.0,
    settle: 0.3,
    duration: 3.0,
    kp: 30.0,
    kd: 0.75,
    joint: JointKind::Thigh,
    target: |_| [0.0; 3],
    voltage: [33.6; 2],
    temperature: [30.0; 2],
};
/// On its feet.
const STANDING: DemoMotion = DemoMotion { base: BaseMount::Floating, settle: 1.0, kp: 40.0, kd: 1.0, ..HELD };

const SWING: DemoMotion = DemoMotion {
    what: "held in the air, the thighs swing at 0.8 Hz",
    target: |t| [0.0, 0.4 * (TAU * 0.8 * t).sin(), 0.0],
    ..HELD
};
const CHIRP: DemoMotion = DemoMotion {
    what: "held in the air, a chirp of the thighs from 0.5 to 3.5 Hz",
    target: |t| [0.0, 0.3 * (TAU * (0.5 + 0.5 * t) * t).sin(), 0.0],
    ..HELD
};
const STEP: DemoMotion = DemoMotion {
    what: "held in the air, a step of the thighs",
    duration: 0.5,
    target: |t| [0.0, if t < 0.05 { 0.2 } else { -0.2 }, 0.0],
    ..HELD
};
const THROWS: DemoMotion = DemoMotion {
    what: "held in the air, large steps of the calves with stiff gains",
    duration: 1.0,
    kp: 60.0,
    kd: 1.0,
    joint: JointKind::Calf,
    target: |t| [0.0, 0.0, 0.6 * (TAU * 2.0 * t).sin().signum()],
    ..HELD
};
const SQUATS: DemoMotion =
    DemoMotion { what: "standing, squats at 1 Hz", target: |t| squat(0.2 * (TAU * t).sin()), ..STANDING };
const SLOW_SQUATS: DemoMotion =
    DemoMotion { what: "standing, squats at 0.4 Hz", target: |t| squat(0.2 * (TAU * 0.4 * t).sin()), ..STANDING };
const BATTERY: DemoMotion =
    DemoMotion { what: "standing, squats at 0.4 Hz while the battery empties", voltage: [33.6, 26.0], ..SLOW_SQUATS };
const HEAT: DemoMotion = DemoMotion {
    what: "standing, squats at 0.4 Hz while the motors heat up",
    temperature: [25.0, 85.0],
    ..SLOW_SQUATS
};
const SWAY: DemoMotion = DemoMotion {
    what: "standing, the hips sway at 2 Hz",
    target: |t| [0.25 * (TAU * 2.0 * t).sin(), 0.0, 0.0],
    ..STANDING
};
const LEAN: DemoMotion = DemoMotion {
    what: "standing, the hips lean slowly to both sides",
    target: |t| [0.03 * (TAU * 0.7 * t).sin(), 0.0, 0.0],
    ..STANDING
};
const DROP: DemoMotion =
    DemoMotion { what: "dropped onto its feet from 3 cm", clearance: 0.03, settle: 0.0, duration: 0.5, ..STANDING };

/// Thigh and calf that bend together, so that the foot stays below the hip.
fn squat(bend: f64) -> [f64; 3] {
    [0.0, bend, -2.0 * bend]
}

/// The motion and the quantities for an effect of the catalogue.
pub fn of(effect: &Effect) -> EffectDemo {
    use PlotQuantity::{
        Acceleration, CommandedTorque, DeratingFactor, EstimatedTorque, Force, FrontShare, Gyro, Height,
        InverseDynamicsResidual, LateralAcceleration, Pitch, Position, RollRate, Sideways, Temperature, Time, Velocity,
        VerticalAcceleration, Voltage,
    };
    let (motion, over_time, law) = match effect.name {
        "encoder_offset" => (&SLOW_SQUATS, Height, [Position, Height]),
        "torque_saturation" => (&THROWS, EstimatedTorque, [CommandedTorque, EstimatedTorque]),
        "supply_sag" => (&BATTERY, Height, [Voltage, DeratingFactor]),
        "thermal_derating" => (&HEAT, Height, [Temperature, DeratingFactor]),
        "torque_speed_limit" => (&THROWS, EstimatedTorque, [Velocity, EstimatedTorque]),
        "torque_sensor_delay" => (&CHIRP, EstimatedTorque, [CommandedTorque, EstimatedTorque]),
        "torque_gain" | "load_friction" => (&CHIRP, Position, [EstimatedTorque, InverseDynamicsResidual]),
        "torque_ripple" | "joint_spring" => (&SWING, Position, [Position, InverseDynamicsResidual]),
        "backlash" => (&CHIRP, Position, [Time, InverseDynamicsResidual]),
        "joint_elasticity" => (&STEP, Position, [Time, InverseDynamicsResidual]),
        "coulomb_friction" | "stribeck_friction" => (&SWING, Position, [Velocity, InverseDynamicsResidual]),
        "viscous_friction" => (&CHIRP, Position, [Velocity, InverseDynamicsResidual]),
        "armature" => (&CHIRP, Position, [Acceleration, InverseDynamicsResidual]),
        "payload" | "inertia" => (&SQUATS, Height, [VerticalAcceleration, Force]),
        "com_shift" => (&SLOW_SQUATS, Pitch, [Time, FrontShare]),
        "ground_friction" => (&SWAY, Sideways, [Time, LateralAcceleration]),
        "ground_stiffness" => (&DROP, Height, [Time, Force]),
        "gyro_bias" => (&LEAN, Gyro, [RollRate, Gyro]),
        // What comes late (command_delay, torque_delay, drive_lag); and what has no motion of its own yet.
        _ => (&CHIRP, Position, [CommandedTorque, EstimatedTorque]),
    };
    EffectDemo { motion, over_time, law }
}
