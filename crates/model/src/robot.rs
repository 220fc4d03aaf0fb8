//! Robot model: parameters of bodies, joints, actuators, shapes, contact and control.

use glam::DVec3;

use crate::{Command, Joint, NUM_JOINTS, NUM_LEGS, PerJoint, RigidBody};

/// Robot with the kinematic tree of the Go2: a trunk and four legs of hip, thigh and calf.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotModel {
    /// Name of the model, such as `go2`.
    pub name: String,
    /// Trunk. Its frame is the base frame: x forward, y left, z up.
    pub trunk: RigidBody,
    /// Legs, in the order of [`crate::Leg::ALL`].
    pub legs: [LegModel; NUM_LEGS],
    /// Joints, in the order of [`Joint::ALL`].
    pub joints: [JointModel; NUM_JOINTS],
    /// Collision shapes.
    pub shapes: Shapes,
    /// Contact between the robot and the ground.
    pub contact: Contact,
    /// Gains, rates, and the default pose, to which actions are relative.
    pub control: ControlConfig,
    /// Reading of the gyroscope at rest [rad/s].
    pub gyro_bias: DVec3,
    /// Reduction of motor torque by supply voltage and temperature.
    pub derating: Derating,
}

/// Reduction of motor torque by supply voltage and temperature. It acts if a log contains them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Derating {
    /// Exponent n of `τ · (V / V_ref)ⁿ`; 0 for no effect.
    pub voltage_exponent: f64,
    /// Relative loss of torque per kelvin above [`Derating::reference_temperature_c`], by joint [1/K].
    pub per_kelvin: [f64; NUM_JOINTS],
    /// Temperature above which torque decreases, by joint [°C].
    pub reference_temperature_c: [f64; NUM_JOINTS],
}

impl Derating {
    /// Full torque at any voltage and temperature.
    pub const NONE: Derating =
        Derating { voltage_exponent: 0.0, per_kelvin: [0.0; NUM_JOINTS], reference_temperature_c: [35.0; NUM_JOINTS] };

    /// Returns the factor on a joint's torque.
    ///
    /// `voltage_share` is the supply voltage divided by the reference voltage. `temperature_c` is the motor temperature
    /// [°C]; NaN if it was not measured.
    pub fn derating_factor(&self, joint: usize, voltage_share: f64, temperature_c: f64) -> f64 {
        let hot = (temperature_c - self.reference_temperature_c[joint]).max(0.0);
        voltage_share.max(0.0).powf(self.voltage_exponent) * (1.0 - self.per_kelvin[joint] * hot).max(0.0)
    }
}

impl RobotModel {
    /// Returns the centre of the sphere of a hip's motors in its frame, on the side of its leg [m].
    pub fn hip_centre(&self, leg: usize) -> DVec3 {
        let side = self.legs[leg].origins[0].y.signum();
        self.shapes.hip_centre * DVec3::new(1.0, side, 1.0)
    }

    /// Returns the mass of the whole robot [kg].
    pub fn total_mass(&self) -> f64 {
        self.trunk.mass + self.legs.iter().flat_map(|leg| &leg.bodies).map(|body| body.mass).sum::<f64>()
    }

    /// Returns the torque limit of each joint [N·m].
    pub fn torque_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.torque_limit as f32)
    }

    /// Returns the lowest position of each joint [rad].
    pub fn lower_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.range[0] as f32)
    }

    /// Returns the highest position of each joint [rad].
    pub fn upper_limits(&self) -> PerJoint {
        self.joints.map(|joint| joint.range[1] as f32)
    }

    /// Returns the axis of a joint in its parent's frame: x for a hip, y for thigh and calf.
    pub fn axis(joint: Joint) -> DVec3 {
        match joint.kind {
            crate::JointKind::Hip => DVec3::X,
            crate::JointKind::Thigh | crate::JointKind::Calf => DVec3::Y,
        }
    }
}

/// Leg: a serial chain of three bodies, with the foot at its end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LegModel {
    /// Hip, thigh, calf; the calf includes the foot.
    pub bodies: [RigidBody; 3],
    /// Position of each joint in its parent's frame [m].
    pub origins: [DVec3; 3],
}

/// Joint with its actuator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointModel {
    /// Lowest and highest position [rad].
    pub range: [f64; 2],
    /// Highest torque of the actuator [N·m].
    pub torque_limit: f64,
    /// Highest speed of the actuator [rad/s].
    pub speed_limit: f64,
    /// Rotor inertia reflected to the joint [kg·m²].
    pub armature: f64,
    /// Coefficient of viscous friction [N·m·s/rad].
    pub viscous_friction: f64,
    /// Coulomb friction torque, independent of speed; it also holds the joint at rest [N·m].
    pub coulomb_friction: f64,
    /// Additional friction at low speed.
    pub stribeck_friction: Stribeck,
    /// Friction torque divided by the motor torque.
    pub load_friction: f64,
    /// Spring parallel to the joint, such as a cable.
    pub spring: JointSpring,
    /// Parameters of the actuator.
    pub actuator: ActuatorParams,
}

/// Stribeck friction `breakaway_torque · exp(−(dq / stribeck_velocity)²)`, in addition to Coulomb friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stribeck {
    /// Additional friction torque at rest [N·m]; 0 for none.
    pub breakaway_torque: f64,
    /// Speed at which the additional torque has decayed to 1/e [rad/s].
    pub stribeck_velocity: f64,
}

impl Stribeck {
    /// No additional friction.
    pub const NONE: Self = Self { breakaway_torque: 0.0, stribeck_velocity: 0.1 };
}

/// Spring torque `−stiffness · q + torque_offset` on the joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointSpring {
    /// Stiffness [N·m/rad].
    pub stiffness: f64,
    /// Torque at q = 0: stiffness times rest position [N·m].
    pub torque_offset: f64,
}

impl JointSpring {
    /// No spring.
    pub const NONE: Self = Self { stiffness: 0.0, torque_offset: 0.0 };
}

/// Parameters of an actuator from command to gear torque, in the order in which they act.
///
/// Delays are at most [`ActuatorParams::MAX_DELAY`]. [`ActuatorParams::IDEAL`] is a PD loop without any of the effects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActuatorParams {
    /// Command delay [s].
    pub command_delay: f64,
    /// Encoder reading minus joint position [rad]. PD loop and log use the reading.
    pub encoder_offset: f64,
    /// Time by which the encoder's position is ahead of its velocity [s]. No effect of the catalogue, but a nuisance parameter of the
    /// identification: drives filter the velocity, and simulators update positions with the new velocity.
    pub encoder_lead: f64,
    /// Position gain of the PD loop divided by the commanded gain.
    pub kp_scale: f64,
    /// Velocity gain of the PD loop divided by the commanded gain.
    pub kd_scale: f64,
    /// Saturation torque κ of `κ · tanh(τ / κ)` [N·m]; infinite for none.
    pub saturation: f64,
    /// Delay of the PD loop's torque [s].
    pub torque_delay: f64,
    /// Speed at which back-EMF reduces the torque to zero [rad/s]; infinite for no reduction.
    pub no_load_speed: f64,
    /// Half width of the torque dead zone [N·m]: smaller torques become zero, larger ones are reduced by it.
    pub dead_zone: f64,
    /// Time constant of the first-order lag of the torque [s]; 0 for none.
    pub torque_time_constant: f64,
    /// Motor torque divided by the torque that the current sensor measures.
    pub gain: f64,
    /// Position-dependent torque ripple.
    pub ripple: Ripple,
    /// Backlash of the gear [rad].
    pub backlash: f64,
    /// Stiffness of the gear [N·m/rad]; infinite for a rigid gear.
    pub gear_stiffness: f64,
    /// Delay of the logged torque [s].
    pub sensor_delay: f64,
}

/// Torque ripple `amplitude · sin(cycles · q + phase)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ripple {
    /// Amplitude [N·m].
    pub amplitude: f64,
    /// Number of periods per revolution of the joint.
    pub cycles: f64,
    /// Phase at q = 0 [rad].
    pub phase: f64,
}

impl ActuatorParams {
    /// Returns the encoder reading minus the joint position at a velocity [rad].
    pub fn encoder_error(&self, dq: f64) -> f64 {
        self.encoder_offset + self.encoder_lead * dq
    }

    /// Longest delay [s].
    pub const MAX_DELAY: f64 = 0.04;

    /// Ideal actuator: the commanded torque without delay, lag, saturation or backlash.
    pub const IDEAL: ActuatorParams = ActuatorParams {
        command_delay: 0.0,
        encoder_offset: 0.0,
        encoder_lead: 0.0,
        kp_scale: 1.0,
        kd_scale: 1.0,
        saturation: f64::INFINITY,
        torque_delay: 0.0,
        no_load_speed: f64::INFINITY,
        dead_zone: 0.0,
        torque_time_constant: 0.0,
        gain: 1.0,
        ripple: Ripple { amplitude: 0.0, cycles: 0.0, phase: 0.0 },
        backlash: 0.0,
        gear_stiffness: f64::INFINITY,
        sensor_delay: 0.0,
    };
}

/// Collision shapes, in the frames of their bodies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shapes {
    /// Half sizes of the trunk's box [m].
    pub trunk_half_size: DVec3,
    /// Centre of the sphere that stands for the motors of a left hip, in its frame; that of a right hip is its mirror image [m].
    pub hip_centre: DVec3,
    /// Radius of this sphere [m].
    pub hip_radius: f64,
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

/// Contact with the ground: spring and damper at the effective mass of the contact, and Coulomb friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Coulomb friction coefficient of the ground.
    pub friction: f64,
    /// Time constant of the contact [s]: `1 / (natural frequency · damping ratio)`, MuJoCo's `solref[0]`.
    pub time_constant: f64,
    /// Damping ratio of the contact, MuJoCo's `solref[1]`.
    pub damping_ratio: f64,
}

/// Contact of the nominal Go2. Friction: menagerie's foot. Compliance: MuJoCo's `solref="0.002 1"`, a stiff foot that penetrates less than a
/// millimetre under the robot's weight. With menagerie's `solimp="0.015 1 0.031"` it penetrates two centimetres. The
/// true value depends on the floor and must be identified.
pub const CONTACT: Contact = Contact { friction: 0.8, time_constant: 0.002, damping_ratio: 1.0 };

/// Conversion of a policy's actions to commands: gains, scale, default pose and rates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlConfig {
    /// Position gain by joint [N·m/rad].
    pub kp: [f64; NUM_JOINTS],
    /// Velocity gain by joint [N·m·s/rad].
    pub kd: [f64; NUM_JOINTS],
    /// Joint offset of an action of 1 [rad].
    pub action_scale: f64,
    /// Joint positions to which actions are relative [rad].
    pub default_pose: [f64; NUM_JOINTS],
    /// Rate of the actuator [Hz].
    pub actuator_hz: f64,
    /// Number of actuator periods per policy period.
    pub decimation: usize,
}

impl ControlConfig {
    /// Returns the actuator period [s].
    pub fn actuator_dt(&self) -> f64 {
        1.0 / self.actuator_hz
    }

    /// Returns the policy period [s].
    pub fn policy_dt(&self) -> f64 {
        self.decimation as f64 / self.actuator_hz
    }

    /// Returns position gain [N·m/rad] and velocity gain [N·m·s/rad] of each joint, or nothing if those of all are equal.
    pub fn joint_gains(&self) -> Vec<[f64; 2]> {
        let gains = |joint: usize| [self.kp[joint], self.kd[joint]];
        if (1..NUM_JOINTS).all(|joint| gains(joint) == gains(0)) {
            return Vec::new();
        }
        (0..NUM_JOINTS).map(gains).collect()
    }

    /// Returns the command that holds positions [rad] with these gains.
    pub fn hold(&self, q: PerJoint) -> Command {
        let single = |gains: [f64; NUM_JOINTS]| gains.map(|gain| gain as f32);
        Command { q, dq: [0.0; NUM_JOINTS], tau_ff: [0.0; NUM_JOINTS], kp: single(self.kp), kd: single(self.kd) }
    }

    /// Returns the default pose in single precision [rad].
    pub fn default_pose_f32(&self) -> PerJoint {
        self.default_pose.map(|position| position as f32)
    }
}
