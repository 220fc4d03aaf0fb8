//! Mass, centre of mass and inertia of a rigid body.

use glam::{DMat3, DQuat, DVec3};

/// Mass properties of one rigid body, in the body's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidBody {
    /// Mass [kg].
    pub mass: f64,
    /// Centre of mass in the body's frame [m].
    pub com: DVec3,
    /// Inertia about the centre of mass, in the axes of the body's frame [kg·m²].
    pub inertia: DMat3,
}

impl RigidBody {
    /// Returns the body with these principal moments of inertia [kg·m²] and rotation body-from-principal.
    pub fn from_principal(mass: f64, com: DVec3, moments: DVec3, body_from_principal: DQuat) -> Self {
        let rotation = DMat3::from_quat(body_from_principal.normalize());
        Self { mass, com, inertia: rotation * DMat3::from_diagonal(moments) * rotation.transpose() }
    }

    /// Returns the mirror image of the body: `signs` is ±1 along each axis.
    pub fn mirrored(self, signs: DVec3) -> Self {
        let mirror = DMat3::from_diagonal(signs);
        Self { mass: self.mass, com: signs * self.com, inertia: mirror * self.inertia * mirror }
    }

    /// Returns the body with mass and inertia multiplied by `factor`, and the same centre of mass.
    pub fn scaled(self, factor: f64) -> Self {
        Self { mass: self.mass * factor, com: self.com, inertia: self.inertia * factor }
    }

    /// Returns the body with another body of the same frame fixed to it.
    pub fn combined(self, other: Self) -> Self {
        let mass = self.mass + other.mass;
        let com = if mass > 0.0 { (self.mass * self.com + other.mass * other.com) / mass } else { self.com };
        let about_com = |body: &Self| body.inertia + body.mass * parallel_axis(body.com - com);
        Self { mass, com, inertia: about_com(&self) + about_com(&other) }
    }

    /// Returns true if mass and inertia are positive.
    pub fn is_physical(&self) -> bool {
        let Self { mass, inertia: i, .. } = self;
        let minor = i.x_axis.x * i.y_axis.y - i.x_axis.y * i.y_axis.x;
        *mass > 0.0 && i.x_axis.x > 0.0 && minor > 0.0 && i.determinant() > 0.0
    }

    /// Returns the body with a point mass [kg] fixed to it at `position` [m, body frame].
    pub fn with_point_mass(self, mass: f64, position: DVec3) -> Self {
        let total = self.mass + mass;
        let com = (self.mass * self.com + mass * position) / total;
        let inertia = self.inertia + self.mass * parallel_axis(self.com - com) + mass * parallel_axis(position - com);
        Self { mass: total, com, inertia }
    }
}

/// Returns the inertia of a unit point mass at `offset` from the origin [m²].
fn parallel_axis(offset: DVec3) -> DMat3 {
    let outer = DMat3::from_cols(offset * offset.x, offset * offset.y, offset * offset.z);
    DMat3::from_diagonal(DVec3::splat(offset.length_squared())) - outer
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn vector(limit: f64) -> impl Strategy<Value = DVec3> {
        (-limit..limit, -limit..limit, -limit..limit).prop_map(|(x, y, z)| DVec3::new(x, y, z))
    }

    proptest! {
        #[test]
        fn point_mass_at_the_centre_of_mass_changes_only_the_mass(com in vector(0.2), mass in 0.1..5.0) {
            let body = RigidBody { mass: 2.0, com, inertia: DMat3::from_diagonal(DVec3::new(0.1, 0.2, 0.25)) };
            let loaded = body.with_point_mass(mass, com);
            prop_assert!((loaded.com - com).length() < 1e-12);
            prop_assert!((loaded.inertia - body.inertia).abs_diff_eq(DMat3::ZERO, 1e-12));
            prop_assert!((loaded.mass - 2.0 - mass).abs() < 1e-12);
        }

        #[test]
        fn two_point_masses_have_the_inertia_of_a_dumbbell(offset in vector(0.5), mass in 0.1..5.0) {
            let half = RigidBody { mass, com: offset, inertia: DMat3::ZERO };
            let dumbbell = half.with_point_mass(mass, -offset);
            prop_assert!(dumbbell.com.length() < 1e-12);
            let textbook = 2.0 * mass * offset.length_squared();
            prop_assert!((dumbbell.inertia * offset.normalize_or_zero()).length() < 1e-9, "zero about its axis");
            let trace = dumbbell.inertia.x_axis.x + dumbbell.inertia.y_axis.y + dumbbell.inertia.z_axis.z;
            prop_assert!((trace - 2.0 * textbook).abs() < 1e-9);
        }
    }
}
