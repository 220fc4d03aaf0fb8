//! What can be estimated at a joint, and its prior.

use twinstep_model::{JointModel, RobotTree, TreeJointKind, TreeModel};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

/// Number at a joint that can be estimated. All are positive, and their priors are log-normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Quantity {
    /// Rotor inertia reflected to the joint [kg·m²].
    Armature,
    /// Coefficient of viscous friction [N·m·s/rad].
    ViscousFriction,
    /// Coulomb friction [N·m].
    CoulombFriction,
    /// Delay of the command [s].
    CommandDelay,
    /// Position gain divided by the stated one, or by [`JointScale::kp`] if it is unknown.
    PositionGain,
    /// Velocity gain divided by the stated one, or by [`JointScale::kd`] if it is unknown.
    VelocityGain,
}

impl Quantity {
    /// All quantities, in the order of their estimates.
    pub const ALL: [Self; 6] = [
        Self::PositionGain,
        Self::VelocityGain,
        Self::Armature,
        Self::ViscousFriction,
        Self::CoulombFriction,
        Self::CommandDelay,
    ];

    /// Returns the effect of the catalogue.
    pub fn effect(self) -> &'static str {
        match self {
            Self::Armature => "armature",
            Self::ViscousFriction => "viscous_friction",
            Self::CoulombFriction => "coulomb_friction",
            Self::CommandDelay => "command_delay",
            Self::PositionGain | Self::VelocityGain => "pd_gain",
        }
    }

    /// Returns the prior at a joint: median, and standard deviation of the logarithm. `known_gains`: the gains are stated.
    ///
    /// The widths reach from robots of the literature to a factor of three beyond them; see [`JointScale`].
    pub fn prior(self, scale: &JointScale, known_gains: bool) -> [f64; 2] {
        match self {
            // 0.1 to 15 ms² of the torque limit: G1 hip 0.1, Go2 0.6, SO-101 15.
            Self::Armature => [1.5e-3 * scale.torque, 2.0],
            // Go2 0.01 s of the torque limit, SO-101 0.3 s.
            Self::ViscousFriction => [0.02 * scale.torque, 2.0],
            // Go2 hips 0.01, calves 0.03, SO-101 0.1 of the torque limit.
            Self::CoulombFriction => [0.03 * scale.torque, 1.5],
            // Real Go2 1 to 6 ms, hobby servos on a bus 60 to 80 ms.
            Self::CommandDelay => [0.015, 1.2],
            // legged_gym and Walk These Ways randomise stated gains by 0.7 to 1.3, and 0.5 to 1.5.
            Self::PositionGain if known_gains => [1.0, 0.15],
            Self::VelocityGain if known_gains => [1.0, 0.3],
            // Go2 0.9 of the torque limit per radian, SO-101 15.
            Self::PositionGain | Self::VelocityGain => [1.0, 1.5],
        }
    }

    /// Returns the lowest and the highest possible value.
    pub fn bounds(self) -> [f64; 2] {
        match self {
            Self::CommandDelay => [0.0, 0.2],
            _ => [0.0, f64::INFINITY],
        }
    }

    /// Returns the number at a joint.
    pub fn get(self, joint: &JointModel) -> f64 {
        *self.slot(&mut joint.clone())
    }

    /// Sets the number at a joint.
    pub fn set(self, joint: &mut JointModel, value: f64) {
        *self.slot(joint) = value;
    }

    fn slot(self, joint: &mut JointModel) -> &mut f64 {
        match self {
            Self::Armature => &mut joint.armature,
            Self::ViscousFriction => &mut joint.viscous_friction,
            Self::CoulombFriction => &mut joint.coulomb_friction,
            Self::CommandDelay => &mut joint.actuator.command_delay,
            Self::PositionGain => &mut joint.actuator.kp_scale,
            Self::VelocityGain => &mut joint.actuator.kd_scale,
        }
    }
}

/// Scale of the numbers of a joint, from which the priors follow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointScale {
    /// Torque limit of the actuator [N·m]; without one, the torque that holds the outer links level and accelerates them by 20 rad/s².
    pub torque: f64,
}

impl JointScale {
    /// Returns the scales of the joints.
    pub fn of(robot: &TreeModel) -> Vec<Self> {
        let scale = |(index, joint): (usize, &JointModel)| Self {
            torque: if joint.torque_limit.is_finite() && joint.torque_limit > 0.0 {
                joint.torque_limit
            } else {
                outer_torque(&robot.tree, index).max(1e-3)
            },
        };
        robot.joints.iter().enumerate().map(scale).collect()
    }

    /// Position gain that stands for an unknown one [N·m/rad]: the torque limit at an error of a third of a radian.
    pub fn kp(&self) -> f64 {
        3.0 * self.torque
    }

    /// Velocity gain that stands for an unknown one [N·m·s/rad].
    pub fn kd(&self) -> f64 {
        0.1 * self.torque
    }
}

/// Returns the torque that holds the links beyond a joint level and accelerates them by 20 rad/s² [N·m], at position 0 of all joints. A slide
/// lifts them and accelerates them by 20 m/s² [N].
fn outer_torque(tree: &RobotTree, index: usize) -> f64 {
    let poses = tree.base_from_bodies(&vec![0.0; tree.joints.len()]);
    let origin = poses[index + 1].translation;
    let mut moved = vec![false; tree.bodies.len()];
    let is_slide = tree.joints[index].kind == TreeJointKind::Prismatic;
    let (mut torque, mut inertia) = (0.0, 0.0);
    for body in index + 1..tree.bodies.len() {
        moved[body] = body == index + 1 || moved[tree.joints[body - 1].parent];
        if moved[body] {
            let link = &tree.bodies[body].inertia;
            if is_slide {
                torque += link.mass * (GRAVITY + 20.0);
                continue;
            }
            let arm = poses[body].transform_point3(link.com).distance(origin);
            torque += link.mass * GRAVITY * arm;
            inertia += link.mass * arm * arm + link.inertia.x_axis.x.max(link.inertia.y_axis.y);
        }
    }
    torque + 20.0 * inertia
}
