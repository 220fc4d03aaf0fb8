//! Constraint rows in the whitened coordinates of [`StepEquations`]: six numbers for the base, one for each joint of a branch.

use twinstep_dynamics::{JointValues, State, StepEquations, Vec3};
use twinstep_simd::SimdFloat;

/// Impedance of a constraint at depth zero and from [`IMPEDANCE_WIDTH`] on: MuJoCo's defaults.
const IMPEDANCE: [f64; 2] = [0.9, 0.95];
/// Stiffness of friction relative to the normal constraint: MuJoCo's `impratio`. Menagerie's Go2 has 100.
///
/// With 1 a standing robot that pushes its feet apart slides by millimetres per second; rubber feet do not creep.
const IMPRATIO: f64 = 30.0;
/// Depth [m] or angle [rad] from which the impedance is the larger one.
const IMPEDANCE_WIDTH: f64 = 0.001;

/// A constraint row that acts on one body. `B` has a number for each joint of the branch of the body.
#[derive(Clone, Debug)]
pub struct ConstraintRow<T, B> {
    /// Coefficients of the base's whitened velocity.
    pub base: [T; 6],
    /// Coefficients of the branch's whitened velocities.
    pub branch: B,
    regularisation: T,
    /// 1 / (A + R) in lanes where the row is active, else 0, so that the impulse stays 0.
    pub inverse: T,
    /// Target velocity change `dt a_ref`.
    target_velocity: T,
}

impl<T: SimdFloat, B: JointValues<T>> ConstraintRow<T, B> {
    /// Creates a row without effect.
    pub fn without_effect(branch: B) -> Self {
        let zero = T::splat(0.0);
        Self { base: [zero; 6], branch, regularisation: zero, inverse: zero, target_velocity: zero }
    }

    /// Returns the velocity change along this row per unit impulse of `other`, a row of the same point.
    ///
    /// For the row itself this is A.
    #[inline(always)]
    pub fn response(&self, other: &Self) -> T {
        let (y, u) = (&self.base, &other.base);
        let base = (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]) + (y[4] * u[4] + y[5] * u[5]);
        let mut along = T::splat(0.0);
        for (z, g) in self.branch.as_ref().iter().zip(other.branch.as_ref()) {
            along += *z * *g;
        }
        base + along
    }

    /// Returns the error of the impulse; positive if it is too large.
    #[inline(always)]
    pub fn impulse_error<E: StepEquations<T, Branch = B>>(&self, equations: &E, body: usize, impulse: T) -> T {
        self.error(equations.velocity_change(body, &self.base, &self.branch), impulse) * self.inverse
    }

    /// Returns the velocity error of the row [m/s] for the velocity change along it and its impulse.
    #[inline(always)]
    pub fn error(&self, velocity_change: T, impulse: T) -> T {
        velocity_change + (self.regularisation * impulse - self.target_velocity)
    }

    /// Applies an impulse along the row.
    #[inline(always)]
    pub fn apply_impulse<E: StepEquations<T, Branch = B>>(&self, equations: &mut E, body: usize, impulse: T) {
        equations.add_impulse(body, &self.base, &self.branch, impulse);
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
    pub fn complete_unilateral<B: JointValues<T>>(&self, row: &mut ConstraintRow<T, B>, velocity: T) {
        let impedance = self.impedance();
        let (response, one) = (row.response(row), T::splat(1.0));
        row.regularisation = (one - impedance) / impedance * response;
        let reference = -(self.damping() * velocity) - self.stiffness() * impedance * self.distance;
        row.inverse = self.distance.select_lt(T::splat(0.0), one / (response + row.regularisation), T::splat(0.0));
        row.target_velocity = reference * self.dt;
    }

    /// Completes a friction row along a tangent.
    ///
    /// It has the normal row's regularisation divided by [`IMPRATIO`], and damping only.
    #[inline(always)]
    pub fn complete_tangent<B: JointValues<T>>(
        &self,
        row: &mut ConstraintRow<T, B>,
        velocity: T,
        normal: &ConstraintRow<T, B>,
    ) {
        let zero = T::splat(0.0);
        row.regularisation = normal.regularisation * T::splat(1.0 / IMPRATIO);
        row.inverse = self.distance.select_lt(zero, T::splat(1.0) / (row.response(row) + row.regularisation), zero);
        row.target_velocity = -(self.damping() * velocity) * self.dt;
    }
}

/// Writes the rows of a contact point.
pub struct PointRow<'a, T: SimdFloat, E: StepEquations<T>> {
    /// Factored equations of motion.
    pub equations: &'a E,
    /// Positions and velocities.
    pub state: &'a State<T, E::Joints>,
    /// Velocity of the base origin in the base frame [m/s].
    pub velocity: Vec3<T>,
    /// Index of the body.
    pub body: usize,
    /// Position of the point in the base frame [m].
    pub place: Vec3<T>,
    /// 1 with a free base, 0 with a fixed base.
    pub moving: T,
}

impl<T: SimdFloat, E: StepEquations<T>> PointRow<'_, T, E> {
    /// Writes the row along `direction` and returns the velocity of the point along it [m/s].
    #[inline(always)]
    pub fn write(&self, row: &mut ConstraintRow<T, E::Branch>, direction: Vec3<T>) -> T {
        let Self { equations, state, body, .. } = *self;
        let turning = self.place.cross(direction);
        let base = [turning.0[0], turning.0[1], turning.0[2], direction.0[0], direction.0[1], direction.0[2]];
        let mut velocity = turning.dot(state.angular_velocity) + direction.dot(self.velocity);
        equations.write_jacobian(body, self.place, direction, &mut row.branch);
        for index in 0..equations.branch_len(body) {
            velocity += row.branch[index] * state.dq[equations.branch_joint(body, index)];
        }
        whiten(equations, row, body, base, self.moving);
        velocity
    }
}

/// Writes the row of a joint, in the direction of a positive impulse, +1 or −1. Returns the body on which it acts.
#[inline(always)]
pub fn write_joint_row<T: SimdFloat, E: StepEquations<T>>(
    equations: &E,
    row: &mut ConstraintRow<T, E::Branch>,
    joint: usize,
    sign: T,
    moving: T,
) -> usize {
    let (body, index) = equations.row_of_joint(joint);
    row.branch.as_mut().fill(T::splat(0.0));
    row.branch[index] = sign;
    whiten(equations, row, body, [T::splat(0.0); 6], moving);
    body
}

/// Writes the row of a velocity of a free base, `direction` of its angular velocity, then of its linear one in base axes.
#[inline(always)]
pub fn write_base_row<T: SimdFloat, E: StepEquations<T>>(
    equations: &E,
    row: &mut ConstraintRow<T, E::Branch>,
    [angular, linear]: [Vec3<T>; 2],
) {
    let ([a, b, c], [d, e, f]) = (angular.0, linear.0);
    row.branch.as_mut().fill(T::splat(0.0));
    whiten(equations, row, 0, [a, b, c, d, e, f], T::splat(1.0));
}

/// Completes the row of dry friction, whose target velocity is zero.
#[inline(always)]
pub fn complete_friction<T: SimdFloat, B: JointValues<T>>(row: &mut ConstraintRow<T, B>, velocity: T) {
    row.inverse = T::splat(1.0) / row.response(row);
    row.target_velocity = -velocity;
}

#[inline(always)]
fn whiten<T: SimdFloat, E: StepEquations<T>>(
    equations: &E,
    row: &mut ConstraintRow<T, E::Branch>,
    body: usize,
    base: [T; 6],
    moving: T,
) {
    row.base = equations.whiten(body, base, &mut row.branch);
    for value in &mut row.base {
        *value = *value * moving;
    }
}
