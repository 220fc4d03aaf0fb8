//! Contacts, joint limits and joint friction: MuJoCo's soft constraints, solved by projected Gauss-Seidel.
//!
//! A row wants the velocity change `J Δ + R λ = dt a_ref` with `a_ref = −b v − k d r` (MuJoCo's documentation,
//! "Computation", reference acceleration): r is the distance, v its rate, and b, k follow from the time constant at
//! critical damping. λ is an impulse [N·s]. Joint friction is hard instead: it stops the joint, as far as it can.

use twinstep_model::lanes::{FactoredDynamics, SimdFloat, State, Vec3};

use super::ground::{TangentPlane, SimdTerrain};
use super::rows::{JointRow, PointRow, ConstraintRow, SoftConstraint};

/// Points of a leg that can touch: the foot, the calf's far end, the knee.
pub const LEG_POINTS: usize = 3;
/// Points of the robot that can touch: of the legs, then the trunk's corners.
pub const POINTS: usize = 4 * LEG_POINTS + 8;

/// Shapes, softness and friction.
#[derive(Clone, Debug)]
pub struct ContactParams<T> {
    /// Centres of a calf's spheres in its frame [m].
    pub leg_points: [[Vec3<T>; LEG_POINTS]; 4],
    /// Their radii [m].
    pub radii: [T; LEG_POINTS],
    /// The trunk's corners in the base frame [m].
    pub corners: [Vec3<T>; 8],
    /// What the robots stand on.
    pub ground: SimdTerrain<T>,
    /// Coefficient of friction at the ground.
    pub friction: T,
    /// Time constant of a contact [s]; at least two steps.
    pub time_constant: T,
    /// Lower and upper joint limits [rad].
    pub limits: [[T; 2]; 12],
    /// Time constant of a joint limit [s]; at least two steps.
    pub limit_time_constant: T,
    /// 1 where the trunk moves, 0 where it is held.
    pub is_floating: T,
}

/// Impulses of the last step, from which the next one starts.
#[derive(Clone, Copy, Debug)]
pub struct Impulses<T> {
    /// By point: normal, and the two directions along the ground [N·s].
    pub points: [[T; 3]; POINTS],
    /// By joint and limit [N·m·s].
    pub limits: [[T; 2]; 12],
    /// Of the joints' friction [N·m·s].
    pub frictions: [T; 12],
}

impl<T: SimdFloat> Impulses<T> {
    /// Nothing touches.
    pub fn zero() -> Self {
        let zero = T::splat(0.0);
        Self { points: [[zero; 3]; POINTS], limits: [[zero; 2]; 12], frictions: [zero; 12] }
    }
}

/// Rows of a point that touches: normal, and two along the ground.
#[derive(Clone, Copy)]
struct PointBlock<T> {
    rows: [ConstraintRow<T>; 3],
    /// What a unit of the normal impulse changes along the other two.
    couplings: [T; 2],
    /// The leg; 4 is the trunk.
    leg: usize,
    point: usize,
}

/// The row of a joint, and where its impulse is kept.
#[derive(Clone, Copy)]
struct JointBlock<T> {
    row: ConstraintRow<T>,
    leg: usize,
    index: usize,
}

/// The first `active` of `blocks` count; there is room for all. Written in place, because blocks are large.
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

/// What is active in one step.
pub struct Constraints<T> {
    points: Active<PointBlock<T>, POINTS>,
    limits: Active<JointBlock<T>, 24>,
    frictions: Active<JointBlock<T>, 12>,
}

impl<T: SimdFloat> Constraints<T> {
    /// Nothing is active. Kept from step to step, because it is large.
    pub fn empty() -> Self {
        let joint = JointBlock { row: ConstraintRow::empty(), leg: 0, index: 0 };
        let point = PointBlock { rows: [ConstraintRow::empty(); 3], couplings: [T::splat(0.0); 2], leg: 0, point: 0 };
        Self { points: Active::empty(point), limits: Active::empty(joint), frictions: Active::empty(joint) }
    }

    /// Finds what touches, and its rows. Impulses of what does not are forgotten. `dry` is the largest torque of each
    /// joint's dry friction [N·m].
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
        let near = surface.ground.near(state);
        // Most of the time no corner of the trunk is near the ground.
        let lowest_corner = near.lowest_corner(surface.corners[7]);
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
            let TangentPlane { height, directions } = near.plane_below(centre);
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
            let row = PointRow { factored, state, velocity: near.velocity, leg, place, moving: surface.is_floating };
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
    fn find_friction(&mut self, factored: &FactoredDynamics<T>, state: &State<T>, surface: &ContactParams<T>, joint: usize) {
        let row = JointRow { factored, joint, sign: T::splat(1.0), moving: surface.is_floating };
        *self.frictions.next() = JointBlock { row: row.friction(state.dq[joint]), leg: joint / 3, index: joint };
    }

    /// Sweeps over all rows; friction at the ground stays inside its disc, friction of a joint below its largest torque.
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
                let most = dry[block.index] * dt;
                let new = (*impulse - row.impulse_error(factored, block.leg, *impulse)).max(-most).min(most);
                row.apply_impulse(factored, block.leg, new - *impulse);
                *impulse = new;
            }
        }
    }
}

/// The normal impulse, then both of friction, and all three at once onto the velocities: what the normal one does to the
/// others is known from `couplings`, so that the sweep waits once a point.
#[inline(always)]
fn solve_point<T: SimdFloat>(factored: &mut FactoredDynamics<T>, block: &PointBlock<T>, impulse: &mut [T; 3], friction: T) {
    let [normal, first, second] = &block.rows;
    let (zero, leg) = (T::splat(0.0), block.leg);
    let missed = [
        normal.velocity_error(factored, leg, impulse[0]),
        first.velocity_error(factored, leg, impulse[1]),
        second.velocity_error(factored, leg, impulse[2]),
    ];
    let pressed = (impulse[0] - missed[0] * normal.inverse).max(zero);
    let more = pressed - impulse[0];
    let mut along = [
        impulse[1] - (missed[1] + block.couplings[0] * more) * first.inverse,
        impulse[2] - (missed[2] + block.couplings[1] * more) * second.inverse,
    ];
    let (limit, square) = (friction * pressed, along[0] * along[0] + along[1] * along[1]);
    if (limit * limit).any_lt(square) {
        let size = square.sqrt();
        let scale = limit.select_lt(size, limit / size.max(T::splat(1e-12)), T::splat(1.0));
        along = [along[0] * scale, along[1] * scale];
    }
    let changes = [more, along[0] - impulse[1], along[1] - impulse[2]];
    for i in 0..6 {
        factored.u[i] += (normal.y[i] * changes[0] + first.y[i] * changes[1]) + second.y[i] * changes[2];
    }
    if leg < 4 {
        for i in 0..3 {
            factored.g[leg][i] += (normal.z[i] * changes[0] + first.z[i] * changes[1]) + second.z[i] * changes[2];
        }
    }
    *impulse = [pressed, along[0], along[1]];
}
