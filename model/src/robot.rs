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
    pub control: Control,
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

impl Contact {
    /// Natural frequency of the contact [Hz].
    pub fn natural_frequency(&self) -> f64 {
        1.0 / (std::f64::consts::TAU * self.time_constant * self.damping_ratio)
    }
}

/// How a policy's action becomes a command, and how the drive follows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Control {
    /// Position gain [N·m/rad].
    pub kp: f64,
    /// Velocity gain [N·m·s/rad].
    pub kd: f64,
    /// Joint offset of a full action [rad].
    pub action_scale: f64,
    /// The pose that actions are offsets from [rad].
    pub default_pose: [f64; NUM_JOINTS],
    /// Rate of the drive [Hz].
    pub drive_hz: f64,
    /// Drive periods in one policy period.
    pub decimation: usize,
}

impl Control {
    /// One period of the drive [s].
    pub fn drive_dt(&self) -> f64 {
        1.0 / self.drive_hz
    }

    /// One period of the policy [s].
    pub fn policy_dt(&self) -> f64 {
        self.decimation as f64 / self.drive_hz
    }

    /// The default pose in single precision [rad].
    pub fn default_pose_f32(&self) -> PerJoint {
        self.default_pose.map(|position| position as f32)
    }
}
