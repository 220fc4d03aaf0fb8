//! Mass and inertia of shapes, as MuJoCo computes them for bodies without `<inertial>`.

use glam::{DAffine3, DMat3, DVec3};
use twinstep_model::{RigidBody, TreeShapeKind};

/// Density of a shape that states neither mass nor density [kg/m³].
pub const DENSITY: f64 = 1000.0;

/// Length below which a shape has none [m].
pub const MIN_LENGTH: f64 = 1e-9;

/// Returns the volume of a shape [m³]. `None` for a mesh.
pub fn volume(kind: TreeShapeKind) -> Option<f64> {
    use std::f64::consts::PI;
    Some(match kind {
        TreeShapeKind::Box(half) => 8.0 * half.x * half.y * half.z,
        TreeShapeKind::Sphere(radius) => 4.0 / 3.0 * PI * radius.powi(3),
        TreeShapeKind::Ellipsoid(radii) => 4.0 / 3.0 * PI * radii.x * radii.y * radii.z,
        TreeShapeKind::Cylinder { radius, half_length } => 2.0 * PI * radius * radius * half_length,
        TreeShapeKind::Capsule { radius, half_length } => {
            PI * radius * radius * (2.0 * half_length + 4.0 / 3.0 * radius)
        }
        TreeShapeKind::Mesh(_) => return None,
    })
}

/// Returns a shape of this mass [kg] as a body about its own centre. `None` for a mesh.
pub fn solid(kind: TreeShapeKind, mass: f64) -> Option<RigidBody> {
    let moments = match kind {
        TreeShapeKind::Box(half) => mass / 3.0 * squares(half),
        TreeShapeKind::Sphere(radius) => DVec3::splat(0.4 * mass * radius * radius),
        TreeShapeKind::Ellipsoid(radii) => mass / 5.0 * squares(radii),
        TreeShapeKind::Cylinder { radius, half_length } => {
            let across = mass * (radius * radius / 4.0 + half_length * half_length / 3.0);
            DVec3::new(across, across, 0.5 * mass * radius * radius)
        }
        TreeShapeKind::Capsule { radius, half_length } => capsule(radius, 2.0 * half_length, mass),
        TreeShapeKind::Mesh(_) => return None,
    };
    Some(RigidBody { mass, com: DVec3::ZERO, inertia: DMat3::from_diagonal(moments) })
}

/// Returns the sums of the squares of the other two components.
fn squares(v: DVec3) -> DVec3 {
    DVec3::new(v.y * v.y + v.z * v.z, v.x * v.x + v.z * v.z, v.x * v.x + v.y * v.y)
}

/// Moments of a cylinder of this length with half spheres at its ends.
fn capsule(radius: f64, length: f64, mass: f64) -> DVec3 {
    let of_spheres = mass * 4.0 * radius / (4.0 * radius + 3.0 * length);
    let of_cylinder = mass - of_spheres;
    let (r2, l2) = (radius * radius, length * length);
    let across = of_cylinder * (3.0 * r2 + l2) / 12.0 + of_spheres * (0.4 * r2 + 0.375 * radius * length + 0.25 * l2);
    DVec3::new(across, across, 0.5 * of_cylinder * r2 + 0.4 * of_spheres * r2)
}

/// Returns a body in the frame that has this pose of its own frame.
pub fn transformed(pose: DAffine3, body: RigidBody) -> RigidBody {
    let rotation = pose.matrix3;
    RigidBody {
        mass: body.mass,
        com: pose.transform_point3(body.com),
        inertia: rotation * body.inertia * rotation.transpose(),
    }
}

/// Returns true if mass and principal moments are those of a real body: positive, and no moment larger than the sum of the others.
pub fn is_real(body: &RigidBody) -> bool {
    let i = &body.inertia;
    let minor = i.x_axis.x * i.y_axis.y - i.x_axis.y * i.y_axis.x;
    body.mass > 0.0 && i.x_axis.x > 0.0 && minor > 0.0 && i.determinant() > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capsule_without_length_is_a_sphere_and_a_thin_one_a_rod() {
        let sphere = solid(TreeShapeKind::Sphere(0.2), 3.0).expect("solid");
        let capsule = solid(TreeShapeKind::Capsule { radius: 0.2, half_length: 0.0 }, 3.0).expect("solid");
        assert!((sphere.inertia - capsule.inertia).to_cols_array().iter().all(|entry| entry.abs() < 1e-12));
        let rod = solid(TreeShapeKind::Capsule { radius: 1e-6, half_length: 0.5 }, 3.0).expect("solid");
        assert!((rod.inertia.x_axis.x - 3.0 / 12.0).abs() < 1e-5);
    }

    #[test]
    fn volumes_agree_with_each_other() {
        let ball = volume(TreeShapeKind::Ellipsoid(DVec3::splat(0.3)));
        let sphere = volume(TreeShapeKind::Sphere(0.3));
        assert!((ball.expect("solid") - sphere.expect("solid")).abs() < 1e-15);
        let parts = volume(TreeShapeKind::Cylinder { radius: 0.3, half_length: 1.0 }).zip(ball);
        let capsule = volume(TreeShapeKind::Capsule { radius: 0.3, half_length: 1.0 });
        assert!((capsule.expect("solid") - parts.map(|(one, other)| one + other).expect("solid")).abs() < 1e-12);
    }
}
