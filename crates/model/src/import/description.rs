//! Links, joints and shapes of a robot file, with fixed links merged into their parents.

use glam::{DMat3, DVec3};

use crate::RigidBody;

/// Robot description.
pub struct Description {
    /// Name of the robot.
    pub name: String,
    /// Links. A link follows its parent; the first is the root.
    pub links: Vec<Link>,
}

/// Link that moves relative to its parent, with everything fixed to it.
pub struct Link {
    /// Name of the link.
    pub name: String,
    /// Mass, in the frame of the link. `None`: the file has none.
    pub body: Option<RigidBody>,
    /// Collision shapes, in the frame of the link.
    pub shapes: Vec<Shape>,
    /// Joint to the parent. `None` for the root.
    pub joint: Option<LinkJoint>,
}

/// Joint between a link and its parent.
pub struct LinkJoint {
    /// Name of the joint.
    pub name: String,
    /// Index of the parent link.
    pub parent: usize,
    /// Pose of the link in the parent's frame at position 0.
    pub pose: Transform,
    /// Axis in the frame of the link.
    pub axis: DVec3,
    /// Lowest and highest position [rad].
    pub range: [f64; 2],
    /// Highest torque of the actuator [N·m]; `None` if the file has none.
    pub torque_limit: Option<f64>,
    /// Highest speed of the actuator [rad/s]; infinite if the file has none.
    pub speed_limit: f64,
    /// Rotor inertia reflected to the joint [kg·m²].
    pub armature: f64,
    /// Coefficient of viscous friction [N·m·s/rad].
    pub damping: f64,
    /// Coulomb friction [N·m].
    pub friction: f64,
}

/// Collision shape.
pub struct Shape {
    /// Name of the geom (MJCF), or of the link that it was defined in (URDF).
    pub name: String,
    /// Kind and size.
    pub kind: ShapeKind,
    /// Pose in the frame of the link. Capsules extend along z.
    pub pose: Transform,
}

/// Kind and size of a shape [m].
#[derive(Clone, Copy)]
pub enum ShapeKind {
    /// Box with these half sizes.
    Box(DVec3),
    /// Sphere of this radius.
    Sphere(f64),
    /// Capsule or cylinder.
    Capsule { radius: f64, half_length: f64 },
}

/// Rotation and translation.
#[derive(Clone, Copy)]
pub struct Transform {
    /// Rotation.
    pub rotation: DMat3,
    /// Translation [m].
    pub translation: DVec3,
}

impl Transform {
    /// No rotation, no translation.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns the transform that applies `inner` first.
    pub fn after(self, inner: Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, translation: self.point(inner.translation) }
    }

    /// Transforms a point.
    pub fn point(self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Transforms a body.
    pub fn body(self, body: RigidBody) -> RigidBody {
        let inertia = self.rotation * body.inertia * self.rotation.transpose();
        RigidBody { mass: body.mass, com: self.point(body.com), inertia }
    }
}

impl Link {
    /// Adds a body that is fixed to the link, in the frame of the link.
    pub fn add_body(&mut self, body: RigidBody) {
        self.body = Some(self.body.map_or(body, |own| own.combined(body)));
    }
}
