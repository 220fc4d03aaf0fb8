//! Constraint rows in the whitened coordinates of [`FactoredDynamics`], nine numbers each.

use twinstep_model::dynamics::{FactoredDynamics, State, Vec3};
use twinstep_simd::SimdFloat;

/// Impedance of a constraint at depth zero and from [`IMPEDANCE_WIDTH`] on: MuJoCo's defaults.
const IMPEDANCE: [f64; 2] = [0.9, 0.95];
/// Stiffness of friction relative to the normal constraint: MuJoCo's `impratio`. Menagerie's Go2 has 100.
///
/// With 1 a standing robot that pushes its feet apart slides by millimetres per second; rubber feet do not creep.
const IMPRATIO: f64 = 30.0;
/// Depth [m] or angle [rad] from which the impedance is the larger one.
const IMPEDANCE_WIDTH: f64 = 0.001;

/// A constraint row.
#[derive(Clone, Copy)]
pub struct ConstraintRow<T> {
    /// Coefficients of the trunk's whitened velocity.
    pub y: [T; 6],
    /// Coefficients of the leg's whitened velocity.
    pub z: [T; 3],
    regularisation: T,
    /// 1 / (A + R) in lanes where the row is active, else 0, so that the impulse stays 0.
    pub inverse: T,
    /// Target velocity change `dt a_ref`.
    target_velocity: T,
}

impl<T: SimdFloat> ConstraintRow<T> {
    /// Creates a row without effect.
    #[inline(always)]
    pub fn empty() -> Self {
        let zero = T::splat(0.0);
        Self { y: [zero; 6], z: [zero; 3], regularisation: zero, inverse: zero, target_velocity: zero }
    }

    /// Creates an inactive row from its Jacobian with respect to the velocities of the trunk and of the leg's joints.
    #[inline(always)]
    fn whitened(factored: &FactoredDynamics<T>, moving: T, leg: usize, mut trunk: [T; 6], joints: [T; 3]) -> Self {
        let zero = T::splat(0.0);
        let mut z = [zero; 3];
        if leg < 4 {
            let part = &factored.legs[leg];
            z = part.factor.forward(joints);
            for (coupling, z) in part.coupling.iter().zip(z) {
                for (entry, w) in trunk.iter_mut().zip(coupling) {
                    *entry -= *w * z;
                }
            }
        }
        let mut y = factored.trunk.forward(trunk);
        for value in &mut y {
            *value = *value * moving;
        }
        Self { y, z, ..Self::empty() }
    }

    /// Returns the velocity change along this row per unit impulse of `other`, a row of the same point.
    ///
    /// For the row itself this is A.
    #[inline(always)]
    pub fn response(&self, other: &Self) -> T {
        self.dot(&other.y, &other.z)
    }

    /// Returns the error of the impulse; positive if it is too large.
    #[inline(always)]
    pub fn impulse_error(&self, factored: &FactoredDynamics<T>, leg: usize, impulse: T) -> T {
        self.velocity_error(factored, leg, impulse) * self.inverse
    }

    /// Returns the velocity error of the row [m/s].
    #[inline(always)]
    pub fn velocity_error(&self, factored: &FactoredDynamics<T>, leg: usize, impulse: T) -> T {
        let zero = T::splat(0.0);
        let g = if leg < 4 { factored.g[leg] } else { [zero; 3] };
        self.dot(&factored.u, &g) + (self.regularisation * impulse - self.target_velocity)
    }

    /// Returns the product with the whitened velocities.
    ///
    /// It is summed in pairs, because the latency of the sum limits the sweep. A chain of additions takes twice as
    /// long.
    #[inline(always)]
    fn dot(&self, u: &[T; 6], g: &[T; 3]) -> T {
        let Self { y, z, .. } = self;
        let trunk = (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]) + (y[4] * u[4] + y[5] * u[5]);
        trunk + ((z[0] * g[0] + z[1] * g[1]) + z[2] * g[2])
    }

    /// Applies an impulse along the row.
    #[inline(always)]
    pub fn apply_impulse(&self, factored: &mut FactoredDynamics<T>, leg: usize, impulse: T) {
        for (u, y) in factored.u.iter_mut().zip(self.y) {
            *u += y * impulse;
        }
        if leg < 4 {
            for (g, z) in factored.g[leg].iter_mut().zip(self.z) {
                *g += z * impulse;
            }
        }
    }
}

/// Compliance and distance of a constraint, which is active where the distance is negative.
pub struct SoftConstraint<T> {
    /// Time constant [s].
    pub time_constant: T,
    /// Distance [m] or angle [rad].
    pub distance: T,
    /// Physics step [s].
    pub dt: T,
}

impl<T: SimdFloat> SoftConstraint<T> {
    /// Returns the impedance d.
    #[inline(always)]
    fn impedance(&self) -> T {
        let [shallow, deep] = IMPEDANCE;
        let depth = ((-self.distance) * T::splat(1.0 / IMPEDANCE_WIDTH)).max(T::splat(0.0)).min(T::splat(1.0));
        T::splat(shallow) + depth * T::splat(deep - shallow)
    }

    /// Returns the damping b of the reference acceleration [1/s].
    #[inline(always)]
    fn damping(&self) -> T {
        T::splat(2.0 / IMPEDANCE[1]) / self.time_constant
    }

    /// Returns the stiffness k of the reference acceleration [1/s²].
    #[inline(always)]
    fn stiffness(&self) -> T {
        T::splat(1.0 / (IMPEDANCE[1] * IMPEDANCE[1])) / (self.time_constant * self.time_constant)
    }

    /// Completes a unilateral row: a contact normal or a joint limit.
    #[inline(always)]
    fn unilateral(&self, row: ConstraintRow<T>, velocity: T) -> ConstraintRow<T> {
        let impedance = self.impedance();
        let (response, one) = (row.response(&row), T::splat(1.0));
        let regularisation = (one - impedance) / impedance * response;
        let reference = -(self.damping() * velocity) - self.stiffness() * impedance * self.distance;
        let inverse = self.distance.select_lt(T::splat(0.0), one / (response + regularisation), T::splat(0.0));
        ConstraintRow { regularisation, inverse, target_velocity: reference * self.dt, ..row }
    }
}

/// Builds the rows of a contact point of a calf, or of the trunk (leg 4).
pub struct PointRow<'a, T> {
    /// Factored equations of motion.
    pub factored: &'a FactoredDynamics<T>,
    /// Positions and velocities.
    pub state: &'a State<T>,
    /// Velocity of the base origin in the base frame [m/s].
    pub velocity: Vec3<T>,
    /// Index of the leg.
    pub leg: usize,
    /// Position of the point in the base frame [m].
    pub place: Vec3<T>,
    /// 1 with a floating base, 0 with a fixed base.
    pub moving: T,
}

impl<T: SimdFloat> PointRow<'_, T> {
    /// Returns the row along the normal of the ground.
    #[inline(always)]
    pub fn normal(&self, direction: Vec3<T>, softness: &SoftConstraint<T>) -> ConstraintRow<T> {
        let (row, velocity) = self.row(direction);
        softness.unilateral(row, velocity)
    }

    /// Returns a friction row along a tangent.
    ///
    /// It has the normal row's regularisation divided by [`IMPRATIO`], and damping only.
    #[inline(always)]
    pub fn tangent(
        &self,
        direction: Vec3<T>,
        softness: &SoftConstraint<T>,
        normal: &ConstraintRow<T>,
    ) -> ConstraintRow<T> {
        let (row, velocity) = self.row(direction);
        let zero = T::splat(0.0);
        let regularisation = normal.regularisation * T::splat(1.0 / IMPRATIO);
        let inverse = softness.distance.select_lt(zero, T::splat(1.0) / (row.response(&row) + regularisation), zero);
        ConstraintRow {
            regularisation,
            inverse,
            target_velocity: -(softness.damping() * velocity) * softness.dt,
            ..row
        }
    }

    /// Returns the row along `direction` and the velocity of the point along it [m/s].
    #[inline(always)]
    fn row(&self, direction: Vec3<T>) -> (ConstraintRow<T>, T) {
        let turning = self.place.cross(direction);
        let trunk = [turning.0[0], turning.0[1], turning.0[2], direction.0[0], direction.0[1], direction.0[2]];
        let mut velocity = turning.dot(self.state.angular_velocity) + direction.dot(self.velocity);
        let mut joints = [T::splat(0.0); 3];
        if self.leg < 4 {
            let jacobian = self.factored.legs[self.leg].frames.calf_jacobian(self.place);
            for i in 0..3 {
                joints[i] = jacobian[i].dot(direction);
                velocity += joints[i] * self.state.dq[3 * self.leg + i];
            }
        }
        (ConstraintRow::whitened(self.factored, self.moving, self.leg, trunk, joints), velocity)
    }
}

/// Builds the rows of a joint.
pub struct JointRow<'a, T> {
    /// Factored equations of motion.
    pub factored: &'a FactoredDynamics<T>,
    /// Index of the joint.
    pub joint: usize,
    /// Direction of a positive impulse, +1 or −1.
    pub sign: T,
    /// 1 with a floating base, 0 with a fixed base.
    pub moving: T,
}

impl<T: SimdFloat> JointRow<'_, T> {
    /// Returns the row of a joint limit.
    #[inline(always)]
    pub fn limit(&self, velocity: T, softness: &SoftConstraint<T>) -> ConstraintRow<T> {
        softness.unilateral(self.row(), velocity)
    }

    /// Returns the row of dry friction, whose target velocity is zero.
    #[inline(always)]
    pub fn friction(&self, velocity: T) -> ConstraintRow<T> {
        let row = self.row();
        ConstraintRow { inverse: T::splat(1.0) / row.response(&row), target_velocity: -velocity, ..row }
    }

    #[inline(always)]
    fn row(&self) -> ConstraintRow<T> {
        let zero = T::splat(0.0);
        let mut along = [zero; 3];
        along[self.joint % 3] = self.sign;
        ConstraintRow::whitened(self.factored, self.moving, self.joint / 3, [zero; 6], along)
    }
}
