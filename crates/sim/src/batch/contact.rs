//! Contacts, joint limits and joint friction: MuJoCo's soft constraints, solved by projected Gauss-Seidel.
//!
//! A constraint row requires `J Δ + R λ = dt a_ref` with `a_ref = −b v − k d r` (MuJoCo's documentation,
//! "Computation", reference acceleration). Δ is the velocity change, λ the impulse [N·s], r the distance, v its rate
//! and d the impedance. b and k follow from the time constant at critical damping. Joint friction is a hard constraint:
//! it stops the joint unless its maximum torque is reached.

use twinstep_model::dynamics::{FactoredDynamics, State, Vec3};
use twinstep_simd::SimdFloat;

use super::ground::{SimdTerrain, TangentPlane};
use super::rows::{ConstraintRow, JointRow, PointRow, SoftConstraint};

/// Number of contact points of a leg: the foot, the distal end of the calf, the knee.
pub const LEG_POINTS: usize = 3;
/// Number of contact points of a robot: those of the legs, then the corners of the trunk.
pub const POINTS: usize = 4 * LEG_POINTS + 8;

/// Parameters of contacts and joint limits.
#[derive(Clone, Debug)]
pub struct ContactParams<T> {
    /// Centres of the contact spheres of each calf, in the calf frame [m].
    pub leg_points: [[Vec3<T>; LEG_POINTS]; 4],
    /// Radii of the contact spheres [m].
    pub radii: [T; LEG_POINTS],
    /// Corners of the trunk in the base frame [m].
    pub corners: [Vec3<T>; 8],
    /// The ground.
    pub ground: SimdTerrain<T>,
    /// Friction coefficient of the ground.
    pub friction: T,
    /// Time constant of a contact [s]; at least two steps.
    pub time_constant: T,
    /// Lower and upper joint limits [rad].
    pub limits: [[T; 2]; 12],
    /// Time constant of a joint limit [s]; at least two steps.
    pub limit_time_constant: T,
    /// 1 with a floating base, 0 with a fixed base.
    pub is_floating: T,
}

/// Impulses of the last step, the initial guess of the next one.
#[derive(Clone, Copy, Debug)]
pub struct Impulses<T> {
    /// Impulse along the normal and the two tangents of each contact point [N·s].
    pub points: [[T; 3]; POINTS],
    /// Impulse of the lower and upper limit of each joint [N·m·s].
    pub limits: [[T; 2]; 12],
    /// Impulse of the friction of each joint [N·m·s].
    pub frictions: [T; 12],
}

impl<T: SimdFloat> Impulses<T> {
    /// Creates impulses of zero.
    pub fn zero() -> Self {
        let zero = T::splat(0.0);
        Self { points: [[zero; 3]; POINTS], limits: [[zero; 2]; 12], frictions: [zero; 12] }
    }
}

/// Constraint rows of an active contact point: normal and two tangents.
#[derive(Clone, Copy)]
struct PointBlock<T> {
    rows: [ConstraintRow<T>; 3],
    /// Velocity change along each tangent per unit of normal impulse.
    couplings: [T; 2],
    /// Index of the leg; 4 is the trunk.
    leg: usize,
    point: usize,
}

/// Constraint row of a joint, and the index of its impulse.
#[derive(Clone, Copy)]
struct JointBlock<T> {
    row: ConstraintRow<T>,
    leg: usize,
    index: usize,
}

/// A vector of fixed capacity, of which the first `active` blocks are valid. Blocks are large, so written in place.
struct Active<B, const N: usize> {
    blocks: Box<[B; N]>,
    active: usize,
}

impl<B: Copy, const N: usize> Active<B, N> {
    fn empty(block: B) -> Self {
        Self { blocks: Box::new([block; N]), active: 0 }
    }

    #[inline(always)]
    fn next(&mut self) -> &mut B {
        self.active += 1;
        &mut self.blocks[self.active - 1]
    }

    #[inline(always)]
    fn all(&self) -> &[B] {
        &self.blocks[..self.active]
    }
}

/// Active constraints of one step.
pub struct Constraints<T> {
    points: Active<PointBlock<T>, POINTS>,
    limits: Active<JointBlock<T>, 24>,
    frictions: Active<JointBlock<T>, 12>,
}

impl<T: SimdFloat> Constraints<T> {
    /// Creates constraints of which none is active. They are large, so the steps share them.
    pub fn empty() -> Self {
        let joint = JointBlock { row: ConstraintRow::empty(), leg: 0, index: 0 };
        let point = PointBlock { rows: [ConstraintRow::empty(); 3], couplings: [T::splat(0.0); 2], leg: 0, point: 0 };
        Self { points: Active::empty(point), limits: Active::empty(joint), frictions: Active::empty(joint) }
    }

    /// Detects the active constraints and computes their rows. Sets the impulses of inactive constraints to zero.
    ///
    /// `dry_friction` is the maximum torque of each joint's dry friction [N·m].
    #[inline(always)]
    pub fn detect(
        &mut self,
        factored: &FactoredDynamics<T>,
        state: &State<T>,
        surface: &ContactParams<T>,
        dry_friction: &[T; 12],
        impulses: &mut Impulses<T>,
        dt: T,
    ) {
        (self.points.active, self.limits.active, self.frictions.active) = (0, 0, 0);
        self.detect_contacts(factored, state, surface, impulses, dt);
        for joint in 0..12 {
            self.find_limits(factored, state, surface, impulses, joint, dt);
            if T::splat(0.0).any_lt(dry_friction[joint]) {
                self.find_friction(factored, state, surface, joint);
            } else {
                impulses.frictions[joint] = T::splat(0.0);
            }
        }
    }

    #[inline(always)]
    fn detect_contacts(
        &mut self,
        factored: &FactoredDynamics<T>,
        state: &State<T>,
        surface: &ContactParams<T>,
        impulses: &mut Impulses<T>,
        dt: T,
    ) {
        let zero = T::splat(0.0);
        let local_ground = surface.ground.local_ground(state);
        // Skips the corners of the trunk, which are rarely near the ground.
        let lowest_corner = local_ground.lowest_corner(surface.corners[7]);
        let points = if lowest_corner.any_lt(zero) { POINTS } else { 4 * LEG_POINTS };
        for corner in &mut impulses.points[points..] {
            *corner = [zero; 3];
        }
        for point in 0..points {
            let (leg, centre, radius) = if point < 4 * LEG_POINTS {
                let (leg, which) = (point / LEG_POINTS, point % LEG_POINTS);
                (leg, factored.legs[leg].frames.calf_point(surface.leg_points[leg][which]), surface.radii[which])
            } else {
                (4, surface.corners[point - 4 * LEG_POINTS], zero)
            };
            let TangentPlane { height, directions } = local_ground.plane_below(centre);
            let distance = height - radius;
            if !distance.any_lt(zero) {
                impulses.points[point] = [zero; 3];
                continue;
            }
            for impulse in &mut impulses.points[point] {
                *impulse = distance.select_lt(zero, *impulse, zero);
            }
            let softness = SoftConstraint { time_constant: surface.time_constant, distance, dt };
            let place = centre - directions[0].scaled(radius);
            let row =
                PointRow { factored, state, velocity: local_ground.velocity, leg, place, moving: surface.is_floating };
            let block = self.points.next();
            (block.leg, block.point) = (leg, point);
            block.rows[0] = row.normal(directions[0], &softness);
            for along in 1..3 {
                block.rows[along] = row.tangent(directions[along], &softness, &block.rows[0]);
                block.couplings[along - 1] = block.rows[along].response(&block.rows[0]);
            }
        }
    }

    #[inline(always)]
    fn find_limits(
        &mut self,
        factored: &FactoredDynamics<T>,
        state: &State<T>,
        surface: &ContactParams<T>,
        impulses: &mut Impulses<T>,
        joint: usize,
        dt: T,
    ) {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        for (side, sign) in [one, -one].into_iter().enumerate() {
            let distance = (state.q[joint] - surface.limits[joint][side]) * sign;
            let impulse = &mut impulses.limits[joint][side];
            if !distance.any_lt(zero) {
                *impulse = zero;
                continue;
            }
            *impulse = distance.select_lt(zero, *impulse, zero);
            let softness = SoftConstraint { time_constant: surface.limit_time_constant, distance, dt };
            let row = JointRow { factored, joint, sign, moving: surface.is_floating };
            let row = row.limit(state.dq[joint] * sign, &softness);
            *self.limits.next() = JointBlock { row, leg: joint / 3, index: 2 * joint + side };
        }
    }

    #[inline(always)]
    fn find_friction(
        &mut self,
        factored: &FactoredDynamics<T>,
        state: &State<T>,
        surface: &ContactParams<T>,
        joint: usize,
    ) {
        let row = JointRow { factored, joint, sign: T::splat(1.0), moving: surface.is_floating };
        *self.frictions.next() = JointBlock { row: row.friction(state.dq[joint]), leg: joint / 3, index: joint };
    }

    /// Solves the constraints by sweeps of projected Gauss–Seidel.
    ///
    /// Friction at the ground is projected onto its disc, friction of a joint onto its torque range.
    #[inline(always)]
    pub fn solve(
        &self,
        factored: &mut FactoredDynamics<T>,
        impulses: &mut Impulses<T>,
        surface: &ContactParams<T>,
        dry: &[T; 12],
        dt: T,
        iterations: usize,
    ) {
        for block in self.points.all() {
            for (row, impulse) in block.rows.iter().zip(impulses.points[block.point]) {
                row.apply_impulse(factored, block.leg, impulse);
            }
        }
        for block in self.limits.all() {
            block.row.apply_impulse(factored, block.leg, impulses.limits[block.index / 2][block.index % 2]);
        }
        for block in self.frictions.all() {
            block.row.apply_impulse(factored, block.leg, impulses.frictions[block.index]);
        }
        for _ in 0..iterations {
            for block in self.points.all() {
                solve_point(factored, block, &mut impulses.points[block.point], surface.friction);
            }
            for block in self.limits.all() {
                let (row, impulse) = (&block.row, &mut impulses.limits[block.index / 2][block.index % 2]);
                let new = (*impulse - row.impulse_error(factored, block.leg, *impulse)).max(T::splat(0.0));
                row.apply_impulse(factored, block.leg, new - *impulse);
                *impulse = new;
            }
            for block in self.frictions.all() {
                let (row, impulse) = (&block.row, &mut impulses.frictions[block.index]);
                let max_impulse = dry[block.index] * dt;
                let new =
                    (*impulse - row.impulse_error(factored, block.leg, *impulse)).max(-max_impulse).min(max_impulse);
                row.apply_impulse(factored, block.leg, new - *impulse);
                *impulse = new;
            }
        }
    }
}

/// Solves the three rows of a contact point: the normal impulse, then both friction impulses.
///
/// `couplings` gives the effect of the normal impulse on the tangents. The velocities are therefore read and updated
/// once per point, whose latency limits the sweep.
#[inline(always)]
fn solve_point<T: SimdFloat>(
    factored: &mut FactoredDynamics<T>,
    block: &PointBlock<T>,
    impulse: &mut [T; 3],
    friction: T,
) {
    let [normal, first, second] = &block.rows;
    let (zero, leg) = (T::splat(0.0), block.leg);
    let errors = [
        normal.velocity_error(factored, leg, impulse[0]),
        first.velocity_error(factored, leg, impulse[1]),
        second.velocity_error(factored, leg, impulse[2]),
    ];
    let normal_impulse = (impulse[0] - errors[0] * normal.inverse).max(zero);
    let normal_change = normal_impulse - impulse[0];
    let mut along = [
        impulse[1] - (errors[1] + block.couplings[0] * normal_change) * first.inverse,
        impulse[2] - (errors[2] + block.couplings[1] * normal_change) * second.inverse,
    ];
    let (limit, square) = (friction * normal_impulse, along[0] * along[0] + along[1] * along[1]);
    if (limit * limit).any_lt(square) {
        let size = square.sqrt();
        let scale = limit.select_lt(size, limit / size.max(T::splat(1e-12)), T::splat(1.0));
        along = [along[0] * scale, along[1] * scale];
    }
    let changes = [normal_change, along[0] - impulse[1], along[1] - impulse[2]];
    for i in 0..6 {
        factored.u[i] += (normal.y[i] * changes[0] + first.y[i] * changes[1]) + second.y[i] * changes[2];
    }
    if leg < 4 {
        for i in 0..3 {
            factored.g[leg][i] += (normal.z[i] * changes[0] + first.z[i] * changes[1]) + second.z[i] * changes[2];
        }
    }
    *impulse = [normal_impulse, along[0], along[1]];
}
