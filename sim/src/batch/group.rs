//! As many robots as there are lanes: their numbers, and one physics step of them all.

use twinstep_model::{Placement, RigidBody, RobotModel, Variation};

use super::contact::{Constraints, Impulses, LEG_POINTS, POINTS, Surface};
use super::dynamics::{Factored, Parameters, State};
use super::lane::Lane;
use super::spatial::{Inertia, Vec3};
use crate::{Base, SimConfig};
use glam::{DVec3, dvec3};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

/// Robots in lanes, with everything that their next step depends on.
#[derive(Clone)]
pub struct Group<T> {
    parameters: Parameters<T>,
    surface: Surface<T>,
    /// What moves.
    pub state: State<T>,
    impulses: Impulses<T>,
    dt: T,
    iterations: usize,
}

/// One robot of a group: its lane of every number.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneSnapshot(Vec<f64>);

impl<T: Lane> Group<T> {
    /// Robots that stand as `placement` says.
    pub fn new(robot: &RobotModel, config: &SimConfig, placement: &Placement) -> Self {
        let zero = T::splat(0.0);
        let legs = &robot.legs;
        let dt = 1.0 / f64::from(config.physics_hz);
        let parameters = Parameters {
            trunk: Inertia::splat(&robot.trunk),
            bodies: legs.map(|leg| leg.bodies.map(|body| Inertia::splat(&body))),
            hip: legs.map(|leg| Vec3::splat(leg.origins[0])),
            thigh: legs.map(|leg| Vec3::splat(leg.origins[1])),
            calf: legs.map(|leg| Vec3::splat(leg.origins[2])),
            armature: robot.joints.map(|joint| T::splat(joint.armature)),
            friction: zero,
            moving: T::splat(if config.base == Base::Floating { 1.0 } else { 0.0 }),
        };
        let mut group = Self {
            parameters,
            surface: surface(robot, config, dt),
            state: State {
                position: Vec3::zero(),
                orientation: [zero; 4],
                linear_velocity: Vec3::zero(),
                angular_velocity: Vec3::zero(),
                q: [zero; 12],
                dq: [zero; 12],
            },
            impulses: Impulses::zero(),
            dt: T::splat(dt),
            iterations: config.solver_iterations as usize,
        };
        for lane in 0..T::LANES {
            group.place(lane, robot, placement);
        }
        group
    }

    /// Places one robot anew.
    pub fn place(&mut self, lane: usize, robot: &RobotModel, placement: &Placement) {
        let Variation { mass_scale, friction_scale, .. } = placement.variation;
        let (trunk, scale) = (varied_trunk(robot, &placement.variation), f64::from(mass_scale));
        self.parameters.trunk.set(lane, &trunk);
        for (bodies, leg) in self.parameters.bodies.iter_mut().zip(&robot.legs) {
            for (body, nominal) in bodies.iter_mut().zip(&leg.bodies) {
                body.set(lane, &nominal.scaled(scale));
            }
        }
        self.parameters.friction.set(lane, robot.contact.friction * f64::from(friction_scale));
        let state = &mut self.state;
        let held = self.parameters.moving.get(lane) == 0.0;
        let velocity = |given: [f32; 3]| if held { [0.0; 3] } else { given };
        set(&mut state.position.0, lane, &placement.base_position);
        set(&mut state.orientation, lane, &placement.base_orientation);
        set(&mut state.linear_velocity.0, lane, &velocity(placement.base_linear_velocity));
        set(&mut state.angular_velocity.0, lane, &velocity(placement.base_angular_velocity));
        set(&mut state.q, lane, &placement.q);
        set(&mut state.dq, lane, &placement.dq);
        for point in &mut self.impulses.points {
            set(point, lane, &[0.0; 3]);
        }
        for limits in &mut self.impulses.limits {
            set(limits, lane, &[0.0; 2]);
        }
    }

    /// Advances all robots by `steps` physics steps under the joint torques `tau` [N·m].
    #[inline(always)]
    pub fn step(&mut self, tau: &[T; 12], steps: usize) {
        let mut constraints = Constraints::with_capacity();
        for _ in 0..steps {
            let mut factored = Factored::new(&self.parameters, &self.state, tau, self.dt, T::splat(GRAVITY));
            let Self { parameters, state, surface, impulses, dt, .. } = self;
            constraints.find(&factored, parameters, state, surface, impulses, *dt);
            constraints.solve(&mut factored, impulses, parameters.friction, self.iterations);
            let (trunk, joints) = factored.solution();
            self.integrate(trunk, joints);
        }
    }

    /// Semi-implicit Euler: velocities first, then positions with the new ones.
    #[inline(always)]
    fn integrate(&mut self, trunk: [T; 6], joints: [T; 12]) {
        let (dt, moving, state) = (self.dt, self.parameters.moving, &mut self.state);
        for (joint, change) in joints.into_iter().enumerate() {
            state.dq[joint] += change;
            state.q[joint] += dt * state.dq[joint];
        }
        let [ax, ay, az, lx, ly, lz] = trunk;
        let axes = state.world_axes();
        let (turn, change) = (Vec3([ax, ay, az]).scaled(moving), Vec3([lx, ly, lz]).scaled(moving));
        state.angular_velocity = state.angular_velocity + turn;
        state.linear_velocity =
            state.linear_velocity + Vec3([axes[0].dot(change), axes[1].dot(change), axes[2].dot(change)]);
        state.position = state.position + state.linear_velocity.scaled(dt);
        state.orientation = turned(state.orientation, state.angular_velocity.scaled(dt));
    }

    /// Normal force on each foot in the last step [N].
    pub fn foot_force(&self, lane: usize, leg: usize) -> f64 {
        self.impulses.points[leg * LEG_POINTS][0].get(lane) / self.dt.get(lane)
    }

    /// True if the trunk or a knee touches the ground.
    pub fn body_contact(&self, lane: usize) -> bool {
        (0..POINTS)
            .filter(|point| *point >= 4 * LEG_POINTS || *point % LEG_POINTS == LEG_POINTS - 1)
            .any(|point| self.impulses.points[point][0].get(lane) > 0.0)
    }

    /// One robot's lane of everything that its next step depends on.
    pub fn snapshot(&self, lane: usize) -> LaneSnapshot {
        let mut values = Vec::new();
        // Reading does not change the clone.
        self.clone().visit(|value| values.push(value.get(lane)));
        LaneSnapshot(values)
    }

    /// Puts one robot back.
    pub fn restore(&mut self, lane: usize, snapshot: &LaneSnapshot) {
        let mut values = snapshot.0.iter();
        self.visit(|value| value.set(lane, *values.next().expect("a snapshot of the same kind of group")));
    }

    /// Visits every number that differs between robots, always in the same order.
    fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
        let Self { parameters, state, impulses, .. } = self;
        let bodies = parameters.bodies.iter_mut().flatten();
        for body in std::iter::once(&mut parameters.trunk).chain(bodies) {
            visit(&mut body.mass);
            body.moment.0.iter_mut().chain(&mut body.about_origin).for_each(&mut visit);
        }
        visit(&mut parameters.friction);
        let State { position, orientation, linear_velocity, angular_velocity, q, dq } = state;
        position.0.iter_mut().chain(orientation).chain(&mut linear_velocity.0).for_each(&mut visit);
        angular_velocity.0.iter_mut().chain(q).chain(dq).for_each(&mut visit);
        impulses.points.iter_mut().flatten().chain(impulses.limits.iter_mut().flatten()).for_each(&mut visit);
    }
}

fn set<T: Lane, const N: usize>(values: &mut [T; N], lane: usize, given: &[f32; N]) {
    for (value, given) in values.iter_mut().zip(given) {
        value.set(lane, f64::from(*given));
    }
}

/// The trunk with the variation's payload and shift.
fn varied_trunk(robot: &RobotModel, variation: &Variation) -> RigidBody {
    let trunk = robot.trunk.scaled(f64::from(variation.mass_scale));
    let trunk = trunk.with_point_mass(f64::from(variation.payload), robot.trunk.com);
    RigidBody { com: trunk.com + DVec3::from(variation.com_shift.map(f64::from)), ..trunk }
}

fn surface<T: Lane>(robot: &RobotModel, config: &SimConfig, dt: f64) -> Surface<T> {
    let shapes = &robot.shapes;
    let points = [shapes.foot_centre, shapes.calf_ends[1], shapes.calf_ends[0]].map(Vec3::splat);
    let half = shapes.trunk_half_size;
    let corner = |index: usize| {
        let sign = |bit: usize| if index >> bit & 1 == 0 { -1.0 } else { 1.0 };
        Vec3::splat(half * dvec3(sign(0), sign(1), sign(2)))
    };
    let normal = DVec3::from(config.terrain.ground().normal.map(f64::from));
    let across = normal.cross(DVec3::X).normalize();
    Surface {
        leg_points: [points; 4],
        radii: [shapes.foot_radius, shapes.calf_radius, shapes.calf_radius].map(T::splat),
        corners: std::array::from_fn(corner),
        ground: [normal, across.cross(normal), across].map(Vec3::splat),
        // Softer than two steps cannot be told from the step itself (MuJoCo's `refsafe`).
        time_constant: T::splat(robot.contact.time_constant.max(2.0 * dt)),
        limits: robot.joints.map(|joint| joint.range.map(T::splat)),
        limit_time_constant: T::splat(2.0 * dt),
    }
}

/// `orientation` turned by the rotation vector `turn` [rad] in its own axes; a Taylor series of the exponential to the
/// third order, then normalised.
#[inline(always)]
fn turned<T: Lane>(orientation: [T; 4], turn: Vec3<T>) -> [T; 4] {
    let half = turn.scaled(T::splat(0.5));
    let square = half.dot(half);
    let [a, b, c] = half.scaled(T::splat(1.0) - square * T::splat(1.0 / 6.0)).0;
    let d = T::splat(1.0) - square * T::splat(0.5);
    let [w, x, y, z] = orientation;
    let product = [
        w * d - x * a - y * b - z * c,
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
    ];
    let mut norm = T::splat(0.0);
    for value in product {
        norm += value * value;
    }
    let inverse = T::splat(1.0) / norm.sqrt();
    [product[0] * inverse, product[1] * inverse, product[2] * inverse, product[3] * inverse]
}
