//! A robot of any shape: bodies in a tree, joined by joints with any axis and frame.

use glam::{DAffine3, DMat3, DVec3};

use crate::{BaseMount, Joint, JointKind, JointSpring, RigidBody, RobotModel};

/// Robot: bodies, joints and collision shapes. A body follows its parent.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotTree {
    /// Name of the robot.
    pub name: String,
    /// Whether the base moves; `None` if nothing says so.
    pub base: Option<BaseMount>,
    /// Forces on a free base.
    pub free_joint: FreeJoint,
    /// World-from-base of a fixed base.
    pub world_from_base: DAffine3,
    /// Bodies. The first is the base; joint `i` moves body `i + 1`.
    pub bodies: Vec<TreeBody>,
    /// Joints.
    pub joints: Vec<TreeJoint>,
    /// Collision shapes.
    pub shapes: Vec<TreeShape>,
}

/// Inertia and friction of a free base, the same for its six velocities: angular in base axes, linear in those of the world.
///
/// No robot has them, but files whose free joint inherits those of all joints do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FreeJoint {
    /// Inertia without weight [kg and kg·m²].
    pub armature: f64,
    /// Coefficient of viscous friction [N·s/m and N·m·s/rad].
    pub damping: f64,
    /// Dry friction [N and N·m].
    pub friction: f64,
}

/// Body with everything that is fixed to it.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeBody {
    /// Name of the body.
    pub name: String,
    /// Mass, in the frame of the body. Zero for a body between two joints at one place.
    pub inertia: RigidBody,
}

/// Kind of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TreeJointKind {
    /// Rotates about its axis; positions in rad.
    Revolute,
    /// Slides along its axis; positions in m.
    Prismatic,
}

/// Joint between a body and its parent. Forces are in N·m for a revolute joint, in N for a prismatic one.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeJoint {
    /// Name of the joint.
    pub name: String,
    /// Kind of the joint.
    pub kind: TreeJointKind,
    /// Index of the parent body.
    pub parent: usize,
    /// Pose of the child's frame in the parent's frame at position 0.
    pub parent_from_child: DAffine3,
    /// Unit vector of the axis in the child's frame.
    pub axis: DVec3,
    /// Lowest and highest position; infinite without limits.
    pub range: [f64; 2],
    /// Lowest and highest force of the actuators; `None` if the file states none.
    pub effort: Option<[f64; 2]>,
    /// Highest speed of the actuator; infinite if the file states none.
    pub speed_limit: f64,
    /// Rotor inertia reflected to the joint [kg·m² or kg].
    pub armature: f64,
    /// Coefficient of viscous friction [N·m·s/rad or N·s/m].
    pub damping: f64,
    /// Coulomb friction [N·m or N].
    pub friction: f64,
    /// Spring parallel to the joint.
    pub spring: JointSpring,
}

/// Collision shape.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeShape {
    /// Name of the shape, or of the link that it was defined in.
    pub name: String,
    /// Index of the body.
    pub body: usize,
    /// Kind and size.
    pub kind: TreeShapeKind,
    /// Pose in the frame of the body. Capsules and cylinders extend along z.
    pub body_from_shape: DAffine3,
}

/// Kind and size of a shape [m].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TreeShapeKind {
    /// Box with these half sizes.
    Box(DVec3),
    /// Sphere with this radius.
    Sphere(f64),
    /// Ellipsoid with these radii.
    Ellipsoid(DVec3),
    /// Cylinder with half spheres at its ends.
    Capsule {
        /// Radius of cylinder and half spheres.
        radius: f64,
        /// Half of the length of the cylinder.
        half_length: f64,
    },
    /// Cylinder.
    Cylinder {
        /// Radius.
        radius: f64,
        /// Half of the length.
        half_length: f64,
    },
    /// Mesh, with the lowest and the highest coordinates of its vertices, if they were read.
    Mesh(Option<[DVec3; 2]>),
}

impl TreeShapeKind {
    /// Returns the shortest of radii and half lengths [m]; infinite for a mesh.
    pub fn shortest_length(self) -> f64 {
        match self {
            Self::Box(lengths) | Self::Ellipsoid(lengths) => lengths.min_element(),
            Self::Sphere(radius) => radius,
            Self::Capsule { radius, half_length } | Self::Cylinder { radius, half_length } => radius.min(half_length),
            Self::Mesh(_) => f64::INFINITY,
        }
    }
}

impl RobotTree {
    /// Returns the mass of all bodies [kg].
    pub fn total_mass(&self) -> f64 {
        self.bodies.iter().map(|body| body.inertia.mass).sum()
    }

    /// Returns the index of the body of the link with this name: of the bodies of a link with several joints, the one that has its mass and
    /// shapes.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.bodies.iter().rposition(|body| body.name == name)
    }

    /// Returns the index of the joint with this name.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Returns the pose of each body in the base frame at the joint positions `q`.
    pub fn base_from_bodies(&self, q: &[f64]) -> Vec<DAffine3> {
        let mut poses = vec![DAffine3::IDENTITY];
        for (joint, q) in self.joints.iter().zip(q) {
            poses.push(poses[joint.parent] * joint.parent_from_child * joint.motion(*q));
        }
        poses
    }
}

impl TreeJoint {
    /// Returns the pose of the child's frame at position `q` in that at position 0.
    pub fn motion(&self, q: f64) -> DAffine3 {
        match self.kind {
            TreeJointKind::Revolute => DAffine3::from_axis_angle(self.axis, q),
            TreeJointKind::Prismatic => DAffine3::from_translation(q * self.axis),
        }
    }
}

impl RobotTree {
    /// Returns the same robot with frames that are parallel at the position 0 of all joints: each frame is turned, and what is in it
    /// turned back.
    #[must_use]
    pub fn with_parallel_frames(&self) -> Self {
        let mut tree = self.clone();
        // Rotation from the frame of each body to its new frame.
        let mut turns = vec![DMat3::IDENTITY];
        for (index, joint) in tree.joints.iter_mut().enumerate() {
            let parent = turns[joint.parent];
            let turn = parent * joint.parent_from_child.matrix3;
            joint.parent_from_child = DAffine3::from_translation(parent * joint.parent_from_child.translation);
            joint.axis = turn * joint.axis;
            turns.push(turn);
            let RigidBody { mass, com, inertia } = tree.bodies[index + 1].inertia;
            tree.bodies[index + 1].inertia =
                RigidBody { mass, com: turn * com, inertia: turn * inertia * turn.transpose() };
        }
        for shape in &mut tree.shapes {
            shape.body_from_shape = DAffine3::from_mat3(turns[shape.body]) * shape.body_from_shape;
        }
        tree
    }
}

/// The tree of a quadruped with a free base. Its collision shapes are left out.
impl From<&RobotModel> for RobotTree {
    fn from(robot: &RobotModel) -> Self {
        let body = |name: &str, inertia: RigidBody| TreeBody { name: name.to_owned(), inertia };
        let inertia = |joint: Joint| robot.legs[joint.leg as usize].bodies[joint.kind as usize];
        let children = Joint::ALL.into_iter().map(|joint| body(joint.name(), inertia(joint)));
        Self {
            name: robot.name.clone(),
            base: Some(BaseMount::Floating),
            free_joint: FreeJoint::default(),
            world_from_base: DAffine3::IDENTITY,
            bodies: std::iter::once(body("trunk", robot.trunk)).chain(children).collect(),
            joints: Joint::ALL.into_iter().map(|joint| tree_joint(robot, joint)).collect(),
            shapes: Vec::new(),
        }
    }
}

fn tree_joint(robot: &RobotModel, joint: Joint) -> TreeJoint {
    let model = &robot.joints[joint.index()];
    TreeJoint {
        name: joint.name().to_owned(),
        kind: TreeJointKind::Revolute,
        // The body before the one of a joint is that of the previous joint of its leg.
        parent: if joint.kind == JointKind::Hip { 0 } else { joint.index() },
        parent_from_child: DAffine3::from_translation(robot.legs[joint.leg as usize].origins[joint.kind as usize]),
        axis: RobotModel::axis(joint),
        range: model.range,
        effort: Some([-model.torque_limit, model.torque_limit]),
        speed_limit: model.speed_limit,
        armature: model.armature,
        damping: model.viscous_friction,
        friction: model.coulomb_friction,
        spring: model.spring,
    }
}
