//! Motions that excite effects, and the quantities in which these are visible, for the plot of an effect.

use std::f64::consts::TAU;

use twinstep_model::{BaseMount, JointKind};

/// Motion that excites an effect, and the quantities in which it is plotted.
#[derive(Clone, Copy, Debug)]
pub struct EffectDemo {
    /// Commanded motion.
    pub motion: &'static DemoMotion,
    /// Quantity that is plotted over time.
    pub over_time: PlotQuantity,
    /// Quantities of the law: x and y.
    pub law: [PlotQuantity; 2],
}

/// Commands of all legs, as offsets from the default pose.
#[derive(Debug)]
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

/// Fixed base, the thighs swing at 0.8 Hz.
pub const SWING: DemoMotion = DemoMotion {
    what: "fixed base, the thighs swing at 0.8 Hz",
    target: |t| [0.0, 0.4 * (TAU * 0.8 * t).sin(), 0.0],
    ..FIXED_BASE
};
/// Fixed base, a chirp of the thighs from 0.5 to 3.5 Hz.
pub const CHIRP: DemoMotion = DemoMotion {
    what: "fixed base, a chirp of the thighs from 0.5 to 3.5 Hz",
    target: |t| [0.0, 0.3 * (TAU * (0.5 + 0.5 * t) * t).sin(), 0.0],
    ..FIXED_BASE
};
/// Fixed base, a step of the thighs.
pub const STEP: DemoMotion = DemoMotion {
    what: "fixed base, a step of the thighs",
    duration: 0.5,
    target: |t| [0.0, if t < 0.05 { 0.2 } else { -0.2 }, 0.0],
    ..FIXED_BASE
};
/// Fixed base, large steps of the calves with high gains.
pub const THROWS: DemoMotion = DemoMotion {
    what: "fixed base, large steps of the calves with high gains",
    duration: 1.0,
    kp: 60.0,
    kd: 1.0,
    joint: JointKind::Calf,
    target: |t| [0.0, 0.0, 0.6 * (TAU * 2.0 * t).sin().signum()],
    ..FIXED_BASE
};
/// Standing, squats at 1 Hz.
pub const SQUATS: DemoMotion =
    DemoMotion { what: "standing, squats at 1 Hz", target: |t| squat(0.2 * (TAU * t).sin()), ..STANDING };
/// Standing, squats at 0.4 Hz.
pub const SLOW_SQUATS: DemoMotion =
    DemoMotion { what: "standing, squats at 0.4 Hz", target: |t| squat(0.2 * (TAU * 0.4 * t).sin()), ..STANDING };
/// Standing, squats at 0.4 Hz while the battery empties.
pub const BATTERY: DemoMotion =
    DemoMotion { what: "standing, squats at 0.4 Hz while the battery empties", voltage: [33.6, 26.0], ..SLOW_SQUATS };
/// Standing, squats at 0.4 Hz while the motors heat up.
pub const HEAT: DemoMotion = DemoMotion {
    what: "standing, squats at 0.4 Hz while the motors heat up",
    temperature: [25.0, 85.0],
    ..SLOW_SQUATS
};
/// Standing, the hips sway at 2 Hz.
pub const SWAY: DemoMotion = DemoMotion {
    what: "standing, the hips sway at 2 Hz",
    target: |t| [0.25 * (TAU * 2.0 * t).sin(), 0.0, 0.0],
    ..STANDING
};
/// Standing, the hips lean slowly to both sides.
pub const LEAN: DemoMotion = DemoMotion {
    what: "standing, the hips lean slowly to both sides",
    target: |t| [0.03 * (TAU * 0.7 * t).sin(), 0.0, 0.0],
    ..STANDING
};
/// Dropped from 3 cm onto the feet.
pub const DROP: DemoMotion =
    DemoMotion { what: "dropped from 3 cm onto the feet", clearance: 0.03, settle: 0.0, duration: 0.5, ..STANDING };

/// Returns the offsets of a squat [rad]: thigh and calf bend together, so that the foot stays below the hip.
fn squat(bend: f64) -> [f64; 3] {
    [0.0, bend, -2.0 * bend]
}

/// Quantity of an actuator period, of the base or of the plotted joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlotQuantity {
    /// Time since the start of the motion [s].
    Time,
    /// Encoder reading of the position [rad].
    Position,
    /// Encoder reading of the velocity [rad/s].
    Velocity,
    /// Mean acceleration over the period [rad/s²].
    Acceleration,
    /// Torque of the ideal actuator for the command and the measured state [N·m].
    CommandedTorque,
    /// Measured motor torque [N·m].
    EstimatedTorque,
    /// Motor torque minus the torque that the ideal robot needs for the same motion [N·m].
    InverseDynamicsResidual,
    /// Height of the base [m].
    Height,
    /// Position of the base, to the left [m].
    Sideways,
    /// Pitch of the base, nose down [rad].
    Pitch,
    /// Roll rate measured by the gyroscope [rad/s].
    Gyro,
    /// True roll rate of the base [rad/s].
    RollRate,
    /// Contact force on all feet [N].
    Force,
    /// Fraction of the contact force that is on the front feet.
    FrontShare,
    /// Upward acceleration of the base plus gravity [m/s²].
    VerticalAcceleration,
    /// Acceleration of the base to the left [m/s²].
    LateralAcceleration,
    /// Battery voltage [V].
    Voltage,
    /// Motor temperature [°C].
    Temperature,
    /// Factor on the torque for supply voltage and motor temperature.
    DeratingFactor,
}

impl PlotQuantity {
    /// Returns the label of an axis, with its unit.
    pub fn label(self) -> &'static str {
        match self {
            Self::Time => "time [s]",
            Self::Position => "joint position [rad]",
            Self::Velocity => "joint velocity [rad/s]",
            Self::Acceleration => "joint acceleration [rad/s²]",
            Self::CommandedTorque => "torque of the ideal actuator [N·m]",
            Self::EstimatedTorque => "measured torque [N·m]",
            Self::InverseDynamicsResidual => "inverse-dynamics residual [N·m]",
            Self::Height => "base height [m]",
            Self::Sideways => "base position to the left [m]",
            Self::Pitch => "base pitch [rad]",
            Self::Gyro => "measured roll rate [rad/s]",
            Self::RollRate => "true roll rate [rad/s]",
            Self::Force => "force on all feet [N]",
            Self::FrontShare => "fraction on the front feet",
            Self::VerticalAcceleration => "upward acceleration + g [m/s²]",
            Self::LateralAcceleration => "acceleration to the left [m/s²]",
            Self::Voltage => "battery voltage [V]",
            Self::Temperature => "motor temperature [°C]",
            Self::DeratingFactor => "derating factor",
        }
    }
}
