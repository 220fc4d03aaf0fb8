//! Log-Cholesky coordinates of mass properties: ten unconstrained numbers, all of which are physically consistent.
//!
//! The pseudo-inertia `J = [[Σ, h], [hᵀ, m]]` (Σ = ∫ x xᵀ dm, h = m c) is positive definite exactly for bodies of
//! positive density. J = U Uᵀ with `U = e^α [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]]`
//! (Rucker and Wensing, "Smooth parameterization of rigid-body inertia", 2022).

use glam::{DMat3, DVec3};

use crate::RigidBody;

impl RigidBody {
    /// Returns the body with log-Cholesky coordinates `[α, d1, d2, d3, s12, s23, s13, t1, t2, t3]` [m, kg].
    pub fn from_log_cholesky(theta: &[f64; 10]) -> Self {
        let [alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3] = *theta;
        let scale = alpha.exp();
        let rows = [[d1.exp(), s12, s13, t1], [0.0, d2.exp(), s23, t2], [0.0, 0.0, d3.exp(), t3], [0.0, 0.0, 0.0, 1.0]]
            .map(|row| row.map(|entry| entry * scale));
        let entry = |i: usize, j: usize| (0..4).map(|k| rows[i][k] * rows[j][k]).sum::<f64>();
        let mass = entry(3, 3);
        let com = DVec3::new(entry(0, 3), entry(1, 3), entry(2, 3)) / mass;
        // Σ about the centre of mass, and I = tr(Σ) 1 − Σ.
        let second = |i: usize, j: usize| entry(i, j) - mass * com[i] * com[j];
        let trace = second(0, 0) + second(1, 1) + second(2, 2);
        let column = |j: usize| {
            DVec3::from_array(std::array::from_fn(|i| if i == j { trace - second(i, j) } else { -second(i, j) }))
        };
        Self { mass, com, inertia: DMat3::from_cols(column(0), column(1), column(2)) }
    }

    /// Returns the log-Cholesky coordinates [m, kg].
    ///
    /// They are not finite if no body of positive density has these mass properties.
    pub fn log_cholesky(&self) -> [f64; 10] {
        let half_trace = 0.5 * (self.inertia.x_axis.x + self.inertia.y_axis.y + self.inertia.z_axis.z);
        let second = |i: usize, j: usize| {
            let own = if i == j { half_trace - self.inertia.col(j)[i] } else { -self.inertia.col(j)[i] };
            own + self.mass * self.com[i] * self.com[j]
        };
        let first = self.com * self.mass;
        // Computes the upper triangular factor U from its last column to its first.
        let (scale, t) = (self.mass.sqrt(), first / self.mass);
        let rest = |i: usize, j: usize| second(i, j) / self.mass - t[i] * t[j];
        let e3 = rest(2, 2).sqrt();
        let (s13, s23) = (rest(0, 2) / e3, rest(1, 2) / e3);
        let e2 = (rest(1, 1) - s23 * s23).sqrt();
        let s12 = (rest(0, 1) - s13 * s23) / e2;
        let e1 = (rest(0, 0) - s12 * s12 - s13 * s13).sqrt();
        [scale.ln(), e1.ln(), e2.ln(), e3.ln(), s12, s23, s13, t.x, t.y, t.z]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::go2;

    #[test]
    fn coordinates_round_trip_for_every_body_of_the_go2() {
        let robot = go2();
        for body in robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]) {
            let again = RigidBody::from_log_cholesky(&body.log_cholesky());
            assert!((again.mass / body.mass - 1.0).abs() < 1e-12);
            assert!((again.com - body.com).length() < 1e-12);
            assert!((again.inertia - body.inertia).to_cols_array().iter().all(|entry| entry.abs() < 1e-12));
        }
    }

    proptest! {
        #[test]
        fn any_ten_coordinates_are_physically_consistent(theta in prop::array::uniform10(-2.0f64..2.0)) {
            let body = RigidBody::from_log_cholesky(&theta);
            prop_assert!(body.mass > 0.0);
            // Positive density: each principal moment is less than the sum of the other two. This is positive
            // definiteness of Σ = tr(I)/2 − I, tested with Sylvester's criterion.
            let half_trace = 0.5 * (body.inertia.x_axis.x + body.inertia.y_axis.y + body.inertia.z_axis.z);
            let sigma = DMat3::from_diagonal(DVec3::splat(half_trace)) - body.inertia;
            let minor = sigma.x_axis.x * sigma.y_axis.y - sigma.x_axis.y * sigma.y_axis.x;
            prop_assert!(sigma.x_axis.x > 0.0 && minor > 0.0 && sigma.determinant() > 0.0, "{sigma}");
            let again = body.log_cholesky();
            for (one, other) in again.iter().zip(theta) {
                prop_assert!((one - other).abs() < 1e-6, "{again:?} of {theta:?}");
            }
        }
    }
}
