//! Shapes of a scene, and how they are made.

use std::sync::Arc;

use glam::{DVec3, Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::kinematics::Pose;

/// Shape of a body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneShape {
    /// Index of the body in [`Scene::bodies`].
    pub body: u32,
    /// Kind of the shape, which determines the meaning of `size`.
    pub kind: ShapeKind,
    /// Size [m]. Box: half sizes along x, y, z. Capsule: radius, half length along z without the caps, 0. Cylinder:
    /// radius, half length along z, 0. Sphere: radius, 0, 0. Convex: 0, 0, 0.
    pub size: [f32; 3],
    /// Pose body-from-shape.
    pub offset: [f32; 7],
    /// Colour: red, green, blue (sRGB) from 0 to 1. `None`: as the viewer likes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub colour: Option<[f32; 3]>,
    /// Surface of a convex shape; `None` for others.
    #[serde(default, skip_serializing_if = "Option::is_none", with = "shared")]
    pub mesh: Option<Arc<ConvexMesh>>,
}

/// Surface of a convex body. The origin is inside.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConvexMesh {
    /// Corners [m].
    pub points: Vec<[f32; 3]>,
    /// Triangles: indices of `points`, counterclockwise from outside.
    pub faces: Vec<[u16; 3]>,
}

/// Kind of a shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShapeKind {
    /// Box.
    Box,
    /// Cylinder with half spheres at its ends.
    Capsule,
    /// Sphere.
    Sphere,
    /// Cylinder with flat ends.
    Cylinder,
    /// Convex body with a [`ConvexMesh`].
    Convex,
}

/// The message has the mesh itself.
mod shared {
    use serde::{Deserializer, Serializer};

    use super::{Arc, ConvexMesh, Deserialize, Serialize};

    #[expect(clippy::ref_option, reason = "serde passes the field")]
    pub fn serialize<S: Serializer>(mesh: &Option<Arc<ConvexMesh>>, to: S) -> Result<S::Ok, S::Error> {
        mesh.as_deref().serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Arc<ConvexMesh>>, D::Error> {
        Ok(Option::deserialize(from)?.map(Arc::new))
    }
}

/// Returns a shape without a colour.
pub(crate) fn shape(body: u32, kind: ShapeKind, size: DVec3, pose: Pose) -> SceneShape {
    SceneShape { body, kind, size: size.as_vec3().to_array(), offset: pose.to_array(), colour: None, mesh: None }
}

/// Returns a sphere.
pub(crate) fn sphere(body: u32, colour: [f32; 3], radius: f64, centre: DVec3) -> SceneShape {
    let pose = Pose { position: centre.as_vec3(), rotation: Quat::IDENTITY };
    SceneShape { colour: Some(colour), ..shape(body, ShapeKind::Sphere, DVec3::new(radius, 0.0, 0.0), pose) }
}

/// Returns the cylinder whose axis is the line segment between `ends`.
pub(crate) fn cylinder(body: u32, colour: [f32; 3], radius: f64, ends: [DVec3; 2]) -> SceneShape {
    SceneShape { colour: Some(colour), ..along(body, ShapeKind::Cylinder, radius, ends) }
}

/// Returns the capsule around the line segment between `ends`.
pub(crate) fn capsule(body: u32, radius: f64, ends: [DVec3; 2]) -> SceneShape {
    along(body, ShapeKind::Capsule, radius, ends)
}

/// Returns the convex body with these corners and triangles.
pub(crate) fn convex(body: u32, colour: [f32; 3], points: &[DVec3], faces: Vec<[u16; 3]>) -> SceneShape {
    let centre = points.iter().sum::<DVec3>() / points.len() as f64;
    let pose = Pose { position: centre.as_vec3(), rotation: Quat::IDENTITY };
    let points = points.iter().map(|point| (*point - centre).as_vec3().to_array()).collect();
    let mesh = Some(Arc::new(ConvexMesh { points, faces }));
    SceneShape { colour: Some(colour), mesh, ..shape(body, ShapeKind::Convex, DVec3::ZERO, pose) }
}

fn along(body: u32, kind: ShapeKind, radius: f64, ends: [DVec3; 2]) -> SceneShape {
    let [from, to] = ends.map(DVec3::as_vec3);
    let rotation = Quat::from_rotation_arc(Vec3::Z, (to - from).normalize_or(Vec3::Z));
    let size = DVec3::new(radius, 0.5 * f64::from(from.distance(to)), 0.0);
    shape(body, kind, size, Pose { position: from.midpoint(to), rotation })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capsule_has_the_given_ends() {
        let ends = [DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.4, 0.5, -0.6)];
        let shape = capsule(0, 0.01, ends);
        let [x, y, z, qw, qx, qy, qz] = shape.offset;
        let tip = Vec3::new(x, y, z) + Quat::from_xyzw(qx, qy, qz, qw) * Vec3::new(0.0, 0.0, shape.size[1]);
        assert!((tip - ends[1].as_vec3()).length() < 1e-6);
    }
}
