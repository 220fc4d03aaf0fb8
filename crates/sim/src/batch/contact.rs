//! Contacts, joint limits and joint friction: MuJoCo's soft constraints, solved by projected Gauss-Seidel.
//!
//! A constraint row requires `J Δ + R λ = dt a_ref` with `a_ref = −b v − k d r` (MuJoCo's documentation,
//! "Computation", reference acceleration). Δ is the velocity change, λ the impulse [N·s], r the distance, v its rate
//! and d the impedance. b and k follow from the time constant at critical damping. Joint friction is a hard constraint:
//! it stops the joint unless its maximum torque is reached.

use twinstep_dynamics::{JointValues, State, StepEquations, Vec3};
use twinstep_simd::SimdFloat;

use super::ground::TangentPlane;
use super::rows::{ConstraintRow, PointRow, SoftConstraint, complete_friction, write_base_row, write_joint_row};
use super::surface::{ContactParams, PointsOfBody, SimdPoint};

/// Returns true if it is worth while to test first whether all points of a body are far from the ground: there are many, or it is
/// one, such as a hip, for which this test is cheaper than that of a contact with a height field.
fn tests_all_first(points: usize) -> bool {
    points == 1 || points >= 5
}

/// Impulses of the last step, the initial guess of the next one.
#[derive(Clone, Debug)]
pub struct Impulses<T> {
    /// Impulse along the normal and the two tangents of each contact, `contacts_of_point` for a point [N·s].
    pub points: Vec<[T; 3]>,
    /// Impulse of the lower and upper limit of each joint [N·m·s or N·s].
    pub limits: Vec<[T; 2]>,
    /// Impulse of the friction of each joint [N·m·s or N·s].
    pub frictions: Vec<T>,
    /// Impulse of the friction of a free base [N·s and N·m·s].
    pub base_frictions: [T; 6],
}

impl<T: SimdFloat> Impulses<T> {
    /// Creates impulses of zero.
    pub fn zero(contacts: usize, joints: usize) -> Self {
        let zero = T::splat(0.0);
        Self {
            points: vec![[zero; 3]; contacts],
            limits: vec![[zero; 2]; joints],
            frictions: vec![zero; joints],
            base_frictions: [zero; 6],
        }
    }

    /// Returns all impulses, always in the same order.
    pub fn all_mut(&mut self) -> impl Iterator<Item = &mut T> {
        let Self { points, limits, frictions, base_frictions } = self;
        points.iter_mut().flatten().chain(limits.iter_mut().flatten()).chain(frictions).chain(base_frictions)
    }
}

/// What the constraints of one step depend on.
pub struct Step<'a, T: SimdFloat, E: StepEquations<T>> {
    /// Factored equations of motion.
    pub equations: &'a E,
    /// Positions and velocities.
    pub state: &'a State<T, E::Joints>,
    /// Contact points, ground and joint limits.
    pub surface: &'a ContactParams<T>,
    /// Physics step [s].
    pub dt: T,
}

/// Constraint rows of a contact: normal and two tangents.
struct PointBlock<T, B> {
    rows: [ConstraintRow<T, B>; 3],
    /// Velocity change along each tangent per unit of normal impulse.
    couplings: [T; 2],
    body: usize,
}

/// Sphere of a body near the ground.
struct TouchingSphere<T> {
    /// Centre in the base frame [m].
    centre: Vec3<T>,
    /// Radius [m].
    radius: T,
    /// Velocity of the base origin in the base frame [m/s].
    velocity: Vec3<T>,
}

/// Constraint row of a joint, and the body on which it acts.
struct JointBlock<T, B> {
    row: ConstraintRow<T, B>,
    body: usize,
}

/// Rows of every constraint, and the indices of those that are active in a step. Rows are large, so written in place.
pub struct Constraints<T, B> {
    points: Vec<PointBlock<T, B>>,
    /// Two for each joint: at the lower and at the upper limit.
    limits: Vec<JointBlock<T, B>>,
    frictions: Vec<JointBlock<T, B>>,
    /// Of a free base: three about the axes of the base, three along those of the world.
    base_frictions: [ConstraintRow<T, B>; 6],
    has_base_friction: bool,
    active_points: Vec<usize>,
    active_limits: Vec<usize>,
    active_frictions: Vec<usize>,
}

impl<T: SimdFloat, B: JointValues<T>> Constraints<T, B> {
    /// Creates constraints of which none is active, for contacts of `bodies`. They are large, so the steps share them.
    pub fn empty<E: StepEquations<T, Branch = B>>(equations: &E, bodies: &[usize], num_joints: usize) -> Self {
        let row = |body: usize| ConstraintRow::without_effect(equations.zero_branch(body));
        let point = |body: &usize| PointBlock {
            rows: [row(*body), row(*body), row(*body)],
            couplings: [T::splat(0.0); 2],
            body: *body,
        };
        let joint = |joint: usize| {
            let body = equations.row_of_joint(joint).0;
            JointBlock { row: row(body), body }
        };
        Self {
            points: bodies.iter().map(point).collect(),
            limits: (0..2 * num_joints).map(|index| joint(index / 2)).collect(),
            frictions: (0..num_joints).map(joint).collect(),
            base_frictions: std::array::from_fn(|_| row(0)),
            has_base_friction: false,
            active_points: Vec::with_capacity(bodies.len()),
            active_limits: Vec::with_capacity(2 * num_joints),
            active_frictions: Vec::with_capacity(num_joints),
        }
    }

    /// Detects the active constraints and computes their rows. Sets the impulses of inactive constraints to zero.
    ///
    /// `dry_friction` is the maximum torque of each joint's dry friction [N·m or N].
    #[inline(always)]
    pub fn detect<E: StepEquations<T, Branch = B>>(
        &mut self,
        step: &Step<'_, T, E>,
        dry_friction: &E::Joints,
        impulses: &mut Impulses<T>,
    ) {
        self.active_points.clear();
        self.active_limits.clear();
        self.active_frictions.clear();
        self.detect_contacts(step, impulses);
        self.has_base_friction = T::splat(0.0).any_lt(step.surface.base_friction);
        if self.has_base_friction {
            self.write_base_friction(step);
        }
        for joint in 0..dry_friction.as_ref().len() {
            self.find_limits(step, impulses, joint);
            if T::splat(0.0).any_lt(dry_friction[joint]) {
                let row = &mut self.frictions[joint].row;
                write_joint_row(step.equations, row, joint, T::splat(1.0), step.surface.is_floating);
                complete_friction(row, step.state.dq[joint]);
                self.active_frictions.push(joint);
            } else {
                impulses.frictions[joint] = T::splat(0.0);
            }
        }
    }

    fn write_base_friction<E: StepEquations<T, Branch = B>>(&mut self, step: &Step<'_, T, E>) {
        let (state, zero, one) = (step.state, T::splat(0.0), T::splat(1.0));
        let world = state.world_axes();
        for (index, row) in self.base_frictions.iter_mut().enumerate() {
            let axis = index % 3;
            let (direction, velocity) = if index < 3 {
                let mut turn = [zero; 3];
                turn[axis] = one;
                ([Vec3(turn), Vec3::zero()], state.angular_velocity.0[axis])
            } else {
                ([Vec3::zero(), world[axis]], state.linear_velocity.0[axis])
            };
            write_base_row(step.equations, row, direction);
            complete_friction(row, velocity);
        }
    }

    #[inline(always)]
    fn detect_contacts<E: StepEquations<T, Branch = B>>(&mut self, step: &Step<'_, T, E>, impulses: &mut Impulses<T>) {
        let zero = T::splat(0.0);
        let (ground, each) = (step.surface.ground.local_ground(step.state), step.surface.ground.contacts_of_point());
        for PointsOfBody { body, points, centre, radius } in &step.surface.bodies {
            if tests_all_first(points.len()) {
                let lowest = ground.lowest_within(step.equations.point(*body, *centre), *radius);
                if !lowest.any_lt(zero) {
                    impulses.points[each * points.start..each * points.end].fill([zero; 3]);
                    continue;
                }
            }
            for point in points.clone() {
                let SimdPoint { centre, radius } = step.surface.points[point];
                let centre = step.equations.point(*body, centre);
                let sphere = TouchingSphere { centre, radius, velocity: ground.velocity };
                for (index, plane) in ground.contacts(centre, radius).into_iter().take(each).enumerate() {
                    let contact = each * point + index;
                    self.detect_contact(step, &sphere, plane, &mut impulses.points[contact], contact);
                }
            }
        }
    }

    #[inline(always)]
    fn detect_contact<E: StepEquations<T, Branch = B>>(
        &mut self,
        step: &Step<'_, T, E>,
        sphere: &TouchingSphere<T>,
        plane: TangentPlane<T>,
        impulses: &mut [T; 3],
        contact: usize,
    ) {
        let (zero, TangentPlane { height, directions }) = (T::splat(0.0), plane);
        let distance = height - sphere.radius;
        if !distance.any_lt(zero) {
            *impulses = [zero; 3];
            return;
        }
        let Step { equations, state, surface, dt } = *step;
        let PointBlock { rows: [normal, tangents @ ..], couplings, body } = &mut self.points[contact];
        for impulse in impulses {
            *impulse = distance.select_lt(zero, *impulse, zero);
        }
        let softness = SoftConstraint { time_constant: surface.time_constant, distance, dt };
        let place = sphere.centre - directions[0].scaled(sphere.radius);
        let row =
            PointRow { equations, state, velocity: sphere.velocity, body: *body, place, moving: surface.is_floating };
        let velocity = row.write(normal, directions[0]);
        softness.complete_unilateral(normal, velocity);
        for (along, tangent) in tangents.iter_mut().enumerate() {
            let velocity = row.write(tangent, directions[along + 1]);
            softness.complete_tangent(tangent, velocity, normal);
            couplings[along] = tangent.response(normal);
        }
        self.active_points.push(contact);
    }

    #[inline(always)]
    fn find_limits<E: StepEquations<T, Branch = B>>(
        &mut self,
        step: &Step<'_, T, E>,
        impulses: &mut Impulses<T>,
        joint: usize,
    ) {
        let Step { equations, state, surface, dt } = *step;
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
            let row = &mut self.limits[2 * joint + side].row;
            write_joint_row(equations, row, joint, sign, surface.is_floating);
            softness.complete_unilateral(row, state.dq[joint] * sign);
            self.active_limits.push(2 * joint + side);
        }
    }

    /// Solves the constraints by sweeps of projected Gauss–Seidel.
    ///
    /// Friction at the ground is projected onto its disc, friction of a joint onto its torque range.
    #[inline(always)]
    pub fn solve<E: StepEquations<T, Branch = B>>(
        &self,
        equations: &mut E,
        impulses: &mut Impulses<T>,
        surface: &ContactParams<T>,
        dry: &E::Joints,
        dt: T,
        iterations: usize,
    ) {
        for index in &self.active_points {
            let block = &self.points[*index];
            for (row, impulse) in block.rows.iter().zip(impulses.points[*index]) {
                row.apply_impulse(equations, block.body, impulse);
            }
        }
        for index in &self.active_limits {
            let JointBlock { row, body } = &self.limits[*index];
            row.apply_impulse(equations, *body, impulses.limits[index / 2][index % 2]);
        }
        for joint in &self.active_frictions {
            let JointBlock { row, body } = &self.frictions[*joint];
            row.apply_impulse(equations, *body, impulses.frictions[*joint]);
        }
        if self.has_base_friction {
            for (row, impulse) in self.base_frictions.iter().zip(&impulses.base_frictions) {
                row.apply_impulse(equations, 0, *impulse);
            }
        }
        for _ in 0..iterations {
            for index in &self.active_points {
                solve_point(equations, &self.points[*index], &mut impulses.points[*index], surface.friction);
            }
            for index in &self.active_limits {
                let (block, impulse) = (&self.limits[*index], &mut impulses.limits[index / 2][index % 2]);
                let JointBlock { row, body } = block;
                let new = (*impulse - row.impulse_error(equations, *body, *impulse)).max(T::splat(0.0));
                row.apply_impulse(equations, *body, new - *impulse);
                *impulse = new;
            }
            for joint in &self.active_frictions {
                let (JointBlock { row, body }, impulse) = (&self.frictions[*joint], &mut impulses.frictions[*joint]);
                solve_friction(equations, row, *body, impulse, dry[*joint] * dt);
            }
            if self.has_base_friction {
                for (row, impulse) in self.base_frictions.iter().zip(&mut impulses.base_frictions) {
                    solve_friction(equations, row, 0, impulse, surface.base_friction * dt);
                }
            }
        }
    }
}

/// Solves a row of dry friction, whose impulse is at most `largest`.
#[inline(always)]
fn solve_friction<T: SimdFloat, E: StepEquations<T>>(
    equations: &mut E,
    row: &ConstraintRow<T, E::Branch>,
    body: usize,
    impulse: &mut T,
    largest: T,
) {
    let new = (*impulse - row.impulse_error(equations, body, *impulse)).max(-largest).min(largest);
    // What slides has reached its maximum, so that nothing changes.
    let change = new - *impulse;
    if T::splat(0.0).any_lt(change.abs()) {
        row.apply_impulse(equations, body, change);
    }
    *impulse = new;
}

/// Solves the three rows of a contact point: the normal impulse, then both friction impulses.
///
/// `couplings` gives the effect of the normal impulse on the tangents. The velocities are therefore read and updated
/// once per point, whose latency limits the sweep.
#[inline(always)]
fn solve_point<T: SimdFloat, E: StepEquations<T>>(
    equations: &mut E,
    block: &PointBlock<T, E::Branch>,
    impulse: &mut [T; 3],
    friction: T,
) {
    let [normal, first, second] = &block.rows;
    let (zero, body) = (T::splat(0.0), block.body);
    let bases = [&normal.base, &first.base, &second.base];
    let branches = [&normal.branch, &first.branch, &second.branch];
    let changes = equations.velocity_changes(body, bases, branches);
    let errors = [
        normal.error(changes[0], impulse[0]),
        first.error(changes[1], impulse[1]),
        second.error(changes[2], impulse[2]),
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
    equations.add_impulses(body, bases, branches, changes);
    *impulse = [normal_impulse, along[0], along[1]];
}
