//! Constraint rows in the whitened coordinates of [`Factored`]: nine numbers each.

use twinstep_model::lanes::{FactoredDynamics, SimdFloat, State, Vec3};

/// Impedance of a constraint at a distance of zero and, from [`IMPEDANCE_WIDTH`] on, deep inside: MuJoCo's defaults.
const IMPEDANCE: [f64; 2] = [0.9, 0.95];
/// How much harder friction is than the push along the normal: MuJoCo's `impratio`, which menagerie has at 100 for the Go2. Rubber
/// feet do not creep; with 1 a robot that stands with its feet pushed apart walks sideways by millimetres a second.
const IMPRATIO: f64 = 30.0;
/// Depth [m] or angle [rad] at which the impedance is the larger one.
const IMPEDANCE_WIDTH: f64 = 0.001;

/// One constraint row.
#[derive(Clone, Copy)]
pub struct ConstraintRow<T> {
    /// By the trunk's whitened velocity.
    pub y: [T; 6],
    /// By the leg's.
    pub z: [T; 3],
    regularisation: T,
    /// One over A + R where the row is active, 0 elsewhere: there its impulse stays 0.
    pub inverse: T,
    /// `dt a_ref`.
    target_velocity: T,
}

impl<T: SimdFloat> ConstraintRow<T> {
    /// A row that does nothing.
    #[inline(always)]
    pub fn empty() -> Self {
        let zero = T::splat(0.0);
        Self { y: [zero; 6], z: [zero; 3], regularisation: zero, inverse: zero, target_velocity: zero }
    }

    /// A row that is active nowhere: `trunk` and `joints` are its Jacobian, by the trunk's velocity and the leg's joints.
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

    /// The velocity change along this row by a unit impulse along another of the same point; with itself, A.
    #[inline(always)]
    pub fn response(&self, other: &Self) -> T {
        self.dot(&other.y, &other.z)
    }

    /// How much the impulse is too large.
    #[inline(always)]
    pub fn impulse_error(&self, factored: &FactoredDynamics<T>, leg: usize, impulse: T) -> T {
        self.velocity_error(factored, leg, impulse) * self.inverse
    }

    /// How far the row is from what it wants [m/s].
    #[inline(always)]
    pub fn velocity_error(&self, factored: &FactoredDynamics<T>, leg: usize, impulse: T) -> T {
        let zero = T::splat(0.0);
        let g = if leg < 4 { factored.g[leg] } else { [zero; 3] };
        self.dot(&factored.u, &g) + (self.regularisation * impulse - self.target_velocity)
    }

    /// Summed in pairs: the sweep waits for each sum, and a chain of additions takes twice as long.
    #[inline(always)]
    fn dot(&self, u: &[T; 6], g: &[T; 3]) -> T {
        let Self { y, z, .. } = self;
        let trunk = (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]) + (y[4] * u[4] + y[5] * u[5]);
        trunk + ((z[0] * g[0] + z[1] * g[1]) + z[2] * g[2])
    }

    /// Applies an impulse.
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

/// How soft a row is, and how far; it is active where the distance is below zero.
pub struct SoftConstraint<T> {
    /// [s]
    pub time_constant: T,
    /// [m] or [rad]
    pub distance: T,
    /// [s]
    pub dt: T,
}

impl<T: SimdFloat> SoftConstraint<T> {
    /// d of the distance.
    #[inline(always)]
    fn impedance(&self) -> T {
        let [shallow, deep] = IMPEDANCE;
        let depth = ((-self.distance) * T::splat(1.0 / IMPEDANCE_WIDTH)).max(T::splat(0.0)).min(T::splat(1.0));
        T::splat(shallow) + depth * T::splat(deep - shallow)
    }

    /// b: of the velocity.
    #[inline(always)]
    fn damping(&self) -> T {
        T::splat(2.0 / IMPEDANCE[1]) / self.time_constant
    }

    /// k: of the distance.
    #[inline(always)]
    fn stiffness(&self) -> T {
        T::splat(1.0 / (IMPEDANCE[1] * IMPEDANCE[1])) / (self.time_constant * self.time_constant)
    }

    /// The row that pushes back out: a normal, or a joint limit.
    #[inline(always)]
    fn unilateral(&self, row: ConstraintRow<T>, velocity: T) -> ConstraintRow<T> {
        let impedance = self.impedance();
        let (response, one) = (row.response(&row), T::splat(1.0));
        let regularisation = (one - impedance) / impedance * response;
        let wanted = -(self.damping() * velocity) - self.stiffness() * impedance * self.distance;
        let inverse = self.distance.select_lt(T::splat(0.0), one / (response + regularisation), T::splat(0.0));
        ConstraintRow { regularisation, inverse, target_velocity: wanted * self.dt, ..row }
    }
}

/// The rows of a point of a leg's calf, or of the trunk (leg 4).
pub struct PointRow<'a, T> {
    /// The equations.
    pub factored: &'a FactoredDynamics<T>,
    /// What moves.
    pub state: &'a State<T>,
    /// Velocity of the base origin in base axes [m/s].
    pub velocity: Vec3<T>,
    /// The leg.
    pub leg: usize,
    /// The point in the base frame [m].
    pub place: Vec3<T>,
    /// 1 where the trunk moves, 0 where it is held.
    pub moving: T,
}

impl<T: SimdFloat> PointRow<'_, T> {
    /// Along the ground's normal.
    #[inline(always)]
    pub fn normal(&self, direction: Vec3<T>, softness: &SoftConstraint<T>) -> ConstraintRow<T> {
        let (row, velocity) = self.row(direction);
        softness.unilateral(row, velocity)
    }

    /// Along the ground: it has a small part of the normal row's regularisation, and only damps.
    #[inline(always)]
    pub fn tangent(&self, direction: Vec3<T>, softness: &SoftConstraint<T>, normal: &ConstraintRow<T>) -> ConstraintRow<T> {
        let (row, velocity) = self.row(direction);
        let zero = T::splat(0.0);
        let regularisation = normal.regularisation * T::splat(1.0 / IMPRATIO);
        let inverse = softness.distance.select_lt(zero, T::splat(1.0) / (row.response(&row) + regularisation), zero);
        ConstraintRow { regularisation, inverse, target_velocity: -(softness.damping() * velocity) * softness.dt, ..row }
    }

    /// The row along `direction`, and the point's velocity along it.
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

/// The rows of a joint.
pub struct JointRow<'a, T> {
    /// The equations.
    pub factored: &'a FactoredDynamics<T>,
    /// The joint.
    pub joint: usize,
    /// +1 or −1: the direction of a positive impulse.
    pub sign: T,
    /// 1 where the trunk moves, 0 where it is held.
    pub moving: T,
}

impl<T: SimdFloat> JointRow<'_, T> {
    /// Back into the joint's range.
    #[inline(always)]
    pub fn limit(&self, velocity: T, softness: &SoftConstraint<T>) -> ConstraintRow<T> {
        softness.unilateral(self.row(), velocity)
    }

    /// Against all motion.
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
