//! Contacts and joint limits: soft constraints as MuJoCo has them, solved by projected Gauss-Seidel.
//!
//! A row wants the velocity change `J Δ + R λ = dt a_ref` with `a_ref = −b v − k d r` (MuJoCo's documentation,
//! "Computation", reference acceleration): r is the distance, v its rate, and b, k follow from the time constant at
//! critical damping. λ is an impulse [N·s].

use super::dynamics::{Factored, Parameters, State};
use super::lane::Lane;
use super::spatial::Vec3;

/// Impedance of a constraint at a distance of zero and, from [`IMPEDANCE_WIDTH`] on, deep inside: MuJoCo's defaults.
const IMPEDANCE: [f64; 2] = [0.9, 0.95];
/// Depth [m] or angle [rad] at which the impedance is the larger one.
const IMPEDANCE_WIDTH: f64 = 0.001;
/// Points of a leg that can touch: the foot, the calf's far end, the knee.
pub const LEG_POINTS: usize = 3;
/// Points of the robot that can touch: of the legs, then the trunk's corners.
pub const POINTS: usize = 4 * LEG_POINTS + 8;

/// Shapes and softness.
#[derive(Clone, Debug)]
pub struct Surface<T> {
    /// Centres of a calf's spheres in its frame [m].
    pub leg_points: [[Vec3<T>; LEG_POINTS]; 4],
    /// Their radii [m].
    pub radii: [T; LEG_POINTS],
    /// The trunk's corners in the base frame [m].
    pub corners: [Vec3<T>; 8],
    /// Normal of the ground, and two directions along it, in the world.
    pub ground: [Vec3<T>; 3],
    /// Time constant of a contact [s]; at least two steps.
    pub time_constant: T,
    /// Lower and upper joint limits [rad].
    pub limits: [[T; 2]; 12],
    /// Time constant of a joint limit [s]; at least two steps.
    pub limit_time_constant: T,
}

/// Impulses of the last step, from which the next one starts.
#[derive(Clone, Copy, Debug)]
pub struct Impulses<T> {
    /// By point: normal, and the two directions along the ground [N·s].
    pub points: [[T; 3]; POINTS],
    /// By joint and limit [N·m·s].
    pub limits: [[T; 2]; 12],
}

impl<T: Lane> Impulses<T> {
    /// No contact.
    pub fn zero() -> Self {
        let zero = T::splat(0.0);
        Self { points: [[zero; 3]; POINTS], limits: [[zero; 2]; 12] }
    }
}

/// One constraint row.
#[derive(Clone, Copy)]
struct Row<T> {
    y: [T; 6],
    z: [T; 3],
    regularisation: T,
    /// One over A + R where the row is active, 0 elsewhere: there its impulse stays 0.
    inverse: T,
    /// `dt a_ref`.
    wanted: T,
}

/// Rows of a point or of a limit, the leg they are on (4: the trunk), and where their impulses are kept.
struct Block<T, const N: usize> {
    rows: [Row<T>; N],
    leg: usize,
    index: usize,
}

/// Most points and limits that are ever active at once are few; both lists hold all.
pub struct Constraints<T> {
    points: Vec<Block<T, 3>>,
    limits: Vec<Block<T, 1>>,
}

impl<T: Lane> Constraints<T> {
    /// Empty lists with room for everything.
    pub fn with_capacity() -> Self {
        Self { points: Vec::with_capacity(POINTS), limits: Vec::with_capacity(24) }
    }

    /// Finds what touches, and its rows. Impulses of what does not are forgotten.
    #[inline(always)]
    pub fn find(
        &mut self,
        factored: &Factored<T>,
        parameters: &Parameters<T>,
        state: &State<T>,
        surface: &Surface<T>,
        impulses: &mut Impulses<T>,
        dt: T,
    ) {
        self.points.clear();
        self.limits.clear();
        let axes = state.world_axes();
        // The ground's directions in base axes, and the base origin's height over it.
        let [normal, first, second] = surface.ground;
        let directions = [to_base(normal, &axes), to_base(first, &axes), to_base(second, &axes)];
        let height = surface.ground[0].dot(state.position);
        let moving = Motion { state, velocity: to_base(state.linear_velocity, &axes), moving: parameters.moving };
        for point in 0..POINTS {
            let (leg, centre, radius) = if point < 4 * LEG_POINTS {
                let (leg, which) = (point / LEG_POINTS, point % LEG_POINTS);
                (leg, factored.legs[leg].calf_point(surface.leg_points[leg][which]), surface.radii[which])
            } else {
                (4, surface.corners[point - 4 * LEG_POINTS], T::splat(0.0))
            };
            let distance = height + directions[0].dot(centre) - radius;
            if !distance.any_less(T::splat(0.0)) {
                impulses.points[point] = [T::splat(0.0); 3];
                continue;
            }
            let lowest = centre - directions[0].scaled(radius);
            let softness = Softness { time_constant: surface.time_constant, distance, dt };
            let normal = contact_row(factored, &moving, leg, lowest, directions[0], &softness, None);
            let regularisation = Some(normal.regularisation);
            let first = contact_row(factored, &moving, leg, lowest, directions[1], &softness, regularisation);
            let second = contact_row(factored, &moving, leg, lowest, directions[2], &softness, regularisation);
            let rows = [normal, first, second];
            let zero = T::splat(0.0);
            for impulse in &mut impulses.points[point] {
                *impulse = distance.select_less(zero, *impulse, zero);
            }
            self.points.push(Block { rows, leg, index: point });
        }
        self.find_limits(factored, parameters, state, surface, impulses, dt);
    }

    #[inline(always)]
    fn find_limits(
        &mut self,
        factored: &Factored<T>,
        parameters: &Parameters<T>,
        state: &State<T>,
        surface: &Surface<T>,
        impulses: &mut Impulses<T>,
        dt: T,
    ) {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        for joint in 0..12 {
            for (side, sign) in [one, -one].into_iter().enumerate() {
                let distance = (state.q[joint] - surface.limits[joint][side]) * sign;
                let impulse = &mut impulses.limits[joint][side];
                if !distance.any_less(zero) {
                    *impulse = zero;
                    continue;
                }
                *impulse = distance.select_less(zero, *impulse, zero);
                let (leg, mut along) = (joint / 3, [zero; 3]);
                along[joint % 3] = sign;
                let softness = Softness { time_constant: surface.limit_time_constant, distance, dt };
                let velocity = state.dq[joint] * sign;
                let row = row(factored, parameters.moving, leg, [zero; 6], along, velocity, &softness, None);
                self.limits.push(Block { rows: [row], leg, index: 2 * joint + side });
            }
        }
    }

    /// Sweeps over all rows; friction stays inside its disc.
    #[inline(always)]
    pub fn solve(&self, factored: &mut Factored<T>, impulses: &mut Impulses<T>, friction: T, iterations: usize) {
        for block in &self.points {
            for (row, impulse) in block.rows.iter().zip(impulses.points[block.index]) {
                push(factored, block.leg, row, impulse);
            }
        }
        for block in &self.limits {
            push(factored, block.leg, &block.rows[0], impulses.limits[block.index / 2][block.index % 2]);
        }
        for _ in 0..iterations {
            for block in &self.points {
                solve_point(factored, block, &mut impulses.points[block.index], friction);
            }
            for block in &self.limits {
                let (row, impulse) = (&block.rows[0], &mut impulses.limits[block.index / 2][block.index % 2]);
                let new = (*impulse - excess(factored, block.leg, row, *impulse)).max(T::splat(0.0));
                push(factored, block.leg, row, new - *impulse);
                *impulse = new;
            }
        }
    }
}

#[inline(always)]
fn solve_point<T: Lane>(factored: &mut Factored<T>, block: &Block<T, 3>, impulse: &mut [T; 3], friction: T) {
    let [normal, first, second] = &block.rows;
    let (zero, leg) = (T::splat(0.0), block.leg);
    let new = (impulse[0] - excess(factored, leg, normal, impulse[0])).max(zero);
    push(factored, leg, normal, new - impulse[0]);
    impulse[0] = new;
    // Both directions from the same state, then back onto the disc.
    let mut along =
        [impulse[1] - excess(factored, leg, first, impulse[1]), impulse[2] - excess(factored, leg, second, impulse[2])];
    let (limit, size) = (friction * new, (along[0] * along[0] + along[1] * along[1]).sqrt());
    let scale = limit.select_less(size, limit / size.max(T::splat(1e-12)), T::splat(1.0));
    along = [along[0] * scale, along[1] * scale];
    push(factored, leg, first, along[0] - impulse[1]);
    push(factored, leg, second, along[1] - impulse[2]);
    (impulse[1], impulse[2]) = (along[0], along[1]);
}

/// How much the row's impulse is too large.
#[inline(always)]
fn excess<T: Lane>(factored: &Factored<T>, leg: usize, row: &Row<T>, impulse: T) -> T {
    let mut sum = row.regularisation * impulse - row.wanted;
    for (y, u) in row.y.iter().zip(factored.u) {
        sum += *y * u;
    }
    if leg < 4 {
        for (z, g) in row.z.iter().zip(factored.g[leg]) {
            sum += *z * g;
        }
    }
    sum * row.inverse
}

#[inline(always)]
fn push<T: Lane>(factored: &mut Factored<T>, leg: usize, row: &Row<T>, impulse: T) {
    for (u, y) in factored.u.iter_mut().zip(row.y) {
        *u += y * impulse;
    }
    if leg < 4 {
        for (g, z) in factored.g[leg].iter_mut().zip(row.z) {
            *g += z * impulse;
        }
    }
}

/// Velocities that a row's rate comes from.
struct Motion<'a, T> {
    state: &'a State<T>,
    /// Linear velocity of the base origin in base axes [m/s].
    velocity: Vec3<T>,
    moving: T,
}

/// A vector of the world in base axes.
#[inline(always)]
fn to_base<T: Lane>(world: Vec3<T>, axes: &[Vec3<T>; 3]) -> Vec3<T> {
    axes[0].scaled(world.0[0]) + axes[1].scaled(world.0[1]) + axes[2].scaled(world.0[2])
}

/// How soft a row is, and how far.
struct Softness<T> {
    time_constant: T,
    distance: T,
    dt: T,
}

/// The row of a point at `place` (base frame) along `direction`. Along the ground it has the normal row's
/// regularisation, and only damps.
#[inline(always)]
fn contact_row<T: Lane>(
    factored: &Factored<T>,
    motion: &Motion<'_, T>,
    leg: usize,
    place: Vec3<T>,
    direction: Vec3<T>,
    softness: &Softness<T>,
    regularisation: Option<T>,
) -> Row<T> {
    let turning = place.cross(direction);
    let trunk = [turning.0[0], turning.0[1], turning.0[2], direction.0[0], direction.0[1], direction.0[2]];
    let mut velocity = turning.dot(motion.state.angular_velocity) + direction.dot(motion.velocity);
    let mut joints = [T::splat(0.0); 3];
    if leg < 4 {
        let part = &factored.legs[leg];
        for (i, joint) in joints.iter_mut().enumerate() {
            *joint = part.axes[i].cross(place - part.origins[i]).dot(direction);
            velocity += *joint * motion.state.dq[3 * leg + i];
        }
    }
    row(factored, motion.moving, leg, trunk, joints, velocity, softness, regularisation)
}

#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "everything a row is made of, once")]
fn row<T: Lane>(
    factored: &Factored<T>,
    moving: T,
    leg: usize,
    mut trunk: [T; 6],
    joints: [T; 3],
    velocity: T,
    softness: &Softness<T>,
    regularisation: Option<T>,
) -> Row<T> {
    let (zero, one) = (T::splat(0.0), T::splat(1.0));
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
    let mut response = zero;
    for value in &mut y {
        *value = *value * moving;
        response += *value * *value;
    }
    for value in z {
        response += value * value;
    }
    let Softness { time_constant, distance, dt } = *softness;
    let [shallow, deep] = IMPEDANCE;
    let depth = ((-distance) * T::splat(1.0 / IMPEDANCE_WIDTH)).max(zero).min(one);
    let impedance = T::splat(shallow) + depth * T::splat(deep - shallow);
    let is_normal = regularisation.is_none();
    let regularisation = match regularisation {
        Some(of_normal) => of_normal,
        None => (one - impedance) / impedance * response,
    };
    let rate = T::splat(2.0 / deep) / time_constant;
    let mut wanted = -(rate * velocity);
    if is_normal {
        let stiffness = T::splat(1.0 / (deep * deep)) / (time_constant * time_constant);
        wanted -= stiffness * impedance * distance;
    }
    let inverse = distance.select_less(zero, one / (response + regularisation), zero);
    Row { y, z, regularisation, inverse, wanted: wanted * dt }
}
