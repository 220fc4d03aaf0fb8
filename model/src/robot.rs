//! What a robot model holds: bodies, joints, shapes, contact and control, all of them plain numbers.

use glam::DVec3;

use crate::{Joint, NUM_JOINTS, NUM_LEGS, PerJoint, RigidBody};

/// A robot with the Go2's tree: a trunk and four legs of hip, thigh and calf.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotModel {
    /// The model's name, such as `go2`.
    pub name: String,
    /// The trunk. Its frame is the base frame: x forward, y left, z up.
    pub trunk: RigidBody,
    /// The legs, in the order of [`crate::Leg::ALL`].
    pub legs: [LegModel; NUM_LEGS],
    /// The joints, in the order of [`Joint::ALL`].
    pub joints: [JointModel; NUM_JOINTS],
    /// Collision shapes.
    pub shapes: Shapes,
    /// Contact between the robot and the ground.
    pub contact: Contact,
    /// Drive gains, rates and the pose that actions are offsets from.
    pub control: ControlConfig,
    /// What the gyroscope shows of a robot at rest [rad/s].
    pub gyro_bias: DVec3,
    /// How supply and heat weaken the motors.
    pub derating: Derating,
}

/// How supply voltage and heat weaken the motors; both act where a log tells voltage and temperature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Derating {
    /// n of `τ · (V / V_ref)ⁿ`; 0 for none.
    pub voltage_exponent: f64,
    /// Torque lost a kelvin above [`Derating::above_c`], by joint [1/K].
    pub per_kelvin: [f64; NUM_JOINTS],
    /// Temperature from which heat counts, by joint [°C].
    pub reference_temperature_c: [f64; NUM_JOINTS],
}

impl Derating {
    /// Full torque at any voltage and temperature.
    pub const NONE: Derating =
        Derating { voltage_exponent: 0.0, per_kelvin: [0.0; NUM_JOINTS], reference_temperature_c: [35.0; NUM_JOINTS] };

    /// What is left of a joint's torque at a share of the reference voltage and a motor temperature [°C]; a temperature
    /// that nobody knows is NaN.
    pub fn derating_factor(&self, joint: usize, voltage_share: f64, temperature_c: f64) -> f64 {
        let hot = (temperature_c - self.reference_temperature_c[joint]).max(0.0);
        voltage_share.max(0.0).powf(self.voltage_exponent) * (1.0 - self.per_kelvin[joint] * hot).max(0.0)
    }
}

impl RobotModel {
    /// Mass of the whole robot [kg].
    pub fn total_mass(&self) -> f64 {
        self.trunk.mass + self.legs.iter().flat_map(|leg| &leg.bodies).map(|body| body.mass).sum::<f64>()
    }

    /// Torque limit of each joint [N·m].
    pub fn torque_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.torque_limit as f32)
    }

    /// Lowest position of each joint [rad].
    pub fn lower_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.range[0] as f32)
    }

    /// Highest position of each joint [rad].
    pub fn upper_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.range[1] as f32)
    }

    /// The joint's axis in its parent's frame: x for a hip, y for thigh and calf.
    pub fn axis(joint: Joint) -> DVec3 {
        match joint.kind {
            crate::JointKind::Hip => DVec3::X,
            crate::JointKind::Thigh | crate::JointKind::Calf => DVec3::Y,
        }
    }
}

/// One leg: three bodies in a chain and the foot at its end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LegModel {
    /// Hip, thigh, calf; the calf includes the foot.
    pub bodies: [RigidBody; 3],
    /// Where each joint sits in its parent's frame [m].
    pub origins: [DVec3; 3],
}

/// One joint with its motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointModel {
    /// Lowest and highest position [rad].
    pub range: [f64; 2],
    /// Highest torque of the drive [N·m].
    pub torque_limit: f64,
    /// Highest speed of the drive [rad/s].
    pub speed_limit: f64,
    /// Inertia of the rotor seen at the joint [kg·m²].
    pub armature: f64,
    /// Friction that grows with the joint's speed [N·m·s/rad].
    pub viscous_friction: f64,
    /// Friction that does not, and that holds the joint when it stands [N·m].
    pub coulomb_friction: f64,
    /// Friction on top at low speed.
    pub stribeck_friction: Stribeck,
    /// Friction in proportion to the motor's torque.
    pub load_friction: f64,
    /// A spring between the links, such as a cable.
    pub spring: JointSpring,
    /// From command to torque.
    pub actuator: ActuatorParams,
}

/// Friction `breakaway · e^(−(dq/speed)²)` on top of the Coulomb friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stribeck {
    /// At rest [N·m]; 0 for none.
    pub breakaway_torque: f64,
    /// Speed at which it has fallen to 1/e [rad/s].
    pub stribeck_velocity: f64,
}

/// Torque `−stiffness · q + torque_at_zero` on the joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointSpring {
    /// [N·m/rad]
    pub stiffness: f64,
    /// At q = 0 [N·m]: stiffness times rest position.
    pub torque_offset: f64,
}

/// What stands between a joint's command and the torque at its gear; [`JointDrive::IDEAL`] has none of it.
///
/// In the order in which it acts. Delays are at most [`JointDrive::LONGEST_DELAY`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActuatorParams {
    /// Commands reach the drive so late [s].
    pub command_delay: f64,
    /// Drive and log see q plus this [rad].
    pub encoder_offset: f64,
    /// κ of `κ · tanh(τ / κ)` [N·m]; infinite for none.
    pub saturation: f64,
    /// The whole loop acts so late [s].
    pub torque_delay: f64,
    /// Speed at which back-EMF leaves no torque [rad/s]; infinite for none.
    pub no_load_speed: f64,
    /// Time constant of the torque [s]; 0 for none.
    pub torque_time_constant: f64,
    /// Factor on the torque between the current's sensor and the gear.
    pub gain: f64,
    /// Torque that the position ripples by.
    pub ripple: Ripple,
    /// Play of the gear [rad].
    pub backlash: f64,
    /// Stiffness of the gear [N·m/rad]; infinite for a rigid one.
    pub gear_stiffness: f64,
    /// What a log shows of the torque is so old [s].
    pub sensor_delay: f64,
}

/// Torque `amplitude · sin(cycles · q + phase)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ripple {
    /// [N·m]
    pub amplitude: f64,
    /// Periods in a turn of the joint.
    pub cycles: f64,
    /// [rad]
    pub phase: f64,
}

impl ActuatorParams {
    /// The longest delay [s]: eight periods of the drive.
    pub const MAX_DELAY: f64 = 0.04;

    /// Commands become torque at once and exactly.
    pub const IDEAL: ActuatorParams = ActuatorParams {
        command_delay: 0.0,
        encoder_offset: 0.0,
        saturation: f64::INFINITY,
        torque_delay: 0.0,
        no_load_speed: f64::INFINITY,
        torque_time_constant: 0.0,
        gain: 1.0,
        ripple: Ripple { amplitude: 0.0, cycles: 0.0, phase: 0.0 },
        backlash: 0.0,
        gear_stiffness: f64::INFINITY,
        sensor_delay: 0.0,
    };
}

/// Collision shapes, in the frames of the bodies they belong to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shapes {
    /// Half sizes of the trunk's box [m].
    pub trunk_half_size: DVec3,
    /// Half sizes of a thigh's box [m].
    pub thigh_half_size: DVec3,
    /// Centre of a thigh's box [m].
    pub thigh_centre: DVec3,
    /// Radius of a calf's capsule [m].
    pub calf_radius: f64,
    /// Both ends of a calf's capsule [m].
    pub calf_ends: [DVec3; 2],
    /// Radius of a foot's sphere [m].
    pub foot_radius: f64,
    /// Centre of a foot's sphere in the calf's frame [m].
    pub foot_centre: DVec3,
}

/// Contact with the ground: a spring and damper that act at the contact's own effective mass, and Coulomb friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Coulomb friction coefficient of the ground.
    pub friction: f64,
    /// Time constant of the contact [s]: `1 / (natural frequency · damping ratio)`, MuJoCo's `solref[0]`.
    pub time_constant: f64,
    /// Damping ratio of the contact, MuJoCo's `solref[1]`.
    pub damping_ratio: f64,
}

/// How a policy's action becomes a command, and how the drive follows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlConfig {
    /// Position gain [N·m/rad].
    pub kp: f64,
    /// Velocity gain [N·m·s/rad].
    pub kd: f64,
    /// Joint offset of a full action [rad].
    pub action_scale: f64,
    /// The pose that actions are offsets from [rad].
    pub default_pose: [f64; NUM_JOINTS],
    /// Rate of the drive [Hz].
    pub actuator_hz: f64,
    /// Drive periods in one policy period.
    pub decimation: usize,
}

impl ControlConfig {
    /// One period of the drive [s].
    pub fn actuator_dt(&self) -> f64 {
        1.0 / self.actuator_hz
    }

    /// One period of the policy [s].
    pub fn policy_dt(&self) -> f64 {
        self.decimation as f64 / self.actuator_hz
    }

    /// The default pose in single precision [rad].
    pub fn default_pose_f32(&self) -> PerJoint {
        self.default_pose.map(|position| position as f32)
    }
}
