//! Motion that excites an effect, and the quantities in which it is visible.

use std::f64::consts::TAU;

use twinstep_effects::Effect;
use twinstep_model::{BaseMount, JointKind};

use super::quantity::PlotQuantity;

/// Motion that excites an effect, and the quantities in which it is plotted.
pub struct EffectDemo {
    /// Commanded motion.
    pub motion: &'static DemoMotion,
    /// Quantity that is plotted over time.
    pub over_time: PlotQuantity,
    /// Quantities of the law: x and y.
    pub law: [PlotQuantity; 2],
}

/// Commands of all legs, as offsets from the default pose.
pub struct DemoMotion {
    /// Description, for the title of the panel.
    pub what: &'static str,
    /// Mounting of the base.
    pub base: BaseMount,
    /// Height of the lowest foot above the ground at the start [m], for a floating base.
    pub clearance: f32,
    /// Duration for which the pose of time 0 is held before the motion [s].
    pub settle: f64,
    /// Duration of the motion [s].
    pub duration: f64,
    /// Position gain [N·m/rad].
    pub kp: f32,
    /// Velocity gain [N·m·s/rad].
    pub kd: f32,
    /// Joint of the front left leg that is plotted.
    pub joint: JointKind,
    /// Offsets of hip, thigh and calf at a time [rad].
    pub target: fn(f64) -> [f64; 3],
    /// Battery voltage at the start and at the end [V].
    pub voltage: [f64; 2],
    /// Motor temperature at the start and at the end [°C].
    pub temperature: [f64; 2],
}

/// Fixed base in the air, the model's own gains, full battery, cold motors.
const FIXED_BASE: DemoMotion = DemoMotion {
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
/// Standing robot.
const STANDING: DemoMotion = DemoMotion { base: BaseMount::Floating, settle: 1.0, kp: 40.0, kd: 1.0, ..FIXED_BASE };

const SWING: DemoMotion = DemoMotion {
    what: "fixed base, the thighs swing at 0.8 Hz",
    target: |t| [0.0, 0.4 * (TAU * 0.8 * t).sin(), 0.0],
    ..FIXED_BASE
};
const CHIRP: DemoMotion = DemoMotion {
    what: "fixed base, a chirp of the thighs from 0.5 to 3.5 Hz",
    target: |t| [0.0, 0.3 * (TAU * (0.5 + 0.5 * t) * t).sin(), 0.0],
    ..FIXED_BASE
};
const STEP: DemoMotion = DemoMotion {
    what: "fixed base, a step of the thighs",
    duration: 0.5,
    target: |t| [0.0, if t < 0.05 { 0.2 } else { -0.2 }, 0.0],
    ..FIXED_BASE
};
const THROWS: DemoMotion = DemoMotion {
    what: "fixed base, large steps of the calves with high gains",
    duration: 1.0,
    kp: 60.0,
    kd: 1.0,
    joint: JointKind::Calf,
    target: |t| [0.0, 0.0, 0.6 * (TAU * 2.0 * t).sin().signum()],
    ..FIXED_BASE
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
    DemoMotion { what: "dropped from 3 cm onto the feet", clearance: 0.03, settle: 0.0, duration: 0.5, ..STANDING };

/// Returns the offsets of a squat [rad]: thigh and calf bend together, so that the foot stays below the hip.
fn squat(bend: f64) -> [f64; 3] {
    [0.0, bend, -2.0 * bend]
}

/// Returns the motion and the quantities for an effect of the catalogue.
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
        // Delays and lags (command_delay, torque_delay, drive_lag), and effects without an entry above.
        _ => (&CHIRP, Position, [CommandedTorque, EstimatedTorque]),
    };
    EffectDemo { motion, over_time, law }
}
