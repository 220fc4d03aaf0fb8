//! State of the robots in one SIMD register, and one physics step of them.

use glam::dvec3;
use twinstep_model::{
    BaseMount, Ground, HistoryStep, InitialState, PerJoint, RobotModel,
    dynamics::{FactoredDynamics, JointLoad, KinematicTree, SimdActuators, SimdCommands, State, Vec3},
};
use twinstep_simd::SimdFloat;

use super::actuator_input::ActuatorInput;
use super::contact::{Constraints, ContactParams, Impulses, LEG_POINTS, POINTS};
use super::ground::SimdTerrain;
use crate::SimConfig;

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

/// State of the robots in one SIMD register, one per lane.
#[derive(Clone)]
pub struct RobotBatch<T> {
    tree: KinematicTree<T>,
    actuator: SimdActuators<T>,
    surface: ContactParams<T>,
    state: State<T>,
    /// Estimated torque, mean over the last actuator period [N·m].
    tau: [T; 12],
    /// Gyroscope bias [rad/s].
    gyro_bias: Vec3<T>,
    impulses: Impulses<T>,
    dt: T,
    iterations: usize,
}

/// Number of steps to advance by.
#[derive(Clone, Copy)]
pub struct StepCount {
    /// Actuator periods.
    pub actuator_periods: usize,
    /// Physics steps per actuator period.
    pub steps: usize,
}

/// Memory for the equations of one step. It is large, so batches and steps share it.
pub struct Workspace<T> {
    factored: FactoredDynamics<T>,
    constraints: Constraints<T>,
}

impl<T: SimdFloat> Workspace<T> {
    /// Creates a workspace without equations.
    pub fn empty() -> Self {
        Self { factored: FactoredDynamics::empty(), constraints: Constraints::empty() }
    }
}

/// Sensor readings of all robots.
pub struct SensorReadings<T> {
    /// Position of the base [m].
    pub position: Vec3<T>,
    /// Orientation of the base, world-from-base.
    pub orientation: [T; 4],
    /// Encoder positions [rad].
    pub q: [T; 12],
    /// Encoder velocities [rad/s].
    pub dq: [T; 12],
}

/// State of one robot of a batch: its lane of every number.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneSnapshot(Vec<f64>);

impl<T: SimdFloat> RobotBatch<T> {
    /// Creates robots in the state `initial_state`.
    pub fn new(robot: &RobotModel, config: &SimConfig, ground: &Ground, initial_state: &InitialState) -> Self {
        let dt = 1.0 / f64::from(config.physics_hz());
        let mut group = Self {
            tree: KinematicTree::splat(robot),
            actuator: SimdActuators::new(robot, dt),
            surface: surface(robot, config, ground, dt),
            state: State::origin(),
            tau: [T::splat(0.0); 12],
            gyro_bias: Vec3::splat(robot.gyro_bias),
            impulses: Impulses::zero(),
            dt: T::splat(dt),
            iterations: config.solver_iterations() as usize,
        };
        for lane in 0..T::LANES {
            group.place(lane, robot, initial_state);
        }
        group
    }

    /// Resets one robot to an initial state.
    pub fn place(&mut self, lane: usize, robot: &RobotModel, initial_state: &InitialState) {
        self.tree.set(lane, robot);
        // An initial state contains encoder readings.
        let q: PerJoint = std::array::from_fn(|joint| {
            let dq = f64::from(initial_state.dq[joint]);
            initial_state.q[joint] - robot.joints[joint].actuator.encoder_error(dq) as f32
        });
        let rotors = self.actuator.set(lane, robot, &q, &initial_state.dq);
        for (armature, rotor) in self.tree.armature.iter_mut().zip(rotors) {
            armature.set(lane, rotor);
        }
        self.gyro_bias.set(lane, robot.gyro_bias);
        self.surface.friction.set(lane, robot.contact.friction);
        // At least two steps, below which the constraint is unstable (MuJoCo's `refsafe`).
        self.surface.time_constant.set(lane, robot.contact.time_constant.max(2.0 * self.dt.get(lane)));

        // `sampled_q` reads positions half a step back, so they are set half a step ahead.
        let half = 0.5 * self.dt.get(lane);
        let moving = self.surface.is_floating.get(lane);
        let [linear, angular] = [initial_state.base_linear_velocity, initial_state.base_angular_velocity]
            .map(|given| Vec3(given.map(|value| moving * f64::from(value))));
        let position = Vec3(initial_state.base_position.map(f64::from)) + linear.scaled(half);
        let state = &mut self.state;
        set(&mut state.position.0, lane, position.0);
        set(
            &mut state.orientation,
            lane,
            integrate_orientation(initial_state.base_orientation.map(f64::from), angular.scaled(half)),
        );
        set(&mut state.linear_velocity.0, lane, linear.0);
        set(&mut state.angular_velocity.0, lane, angular.0);
        let dq = initial_state.dq.map(f64::from);
        set(&mut state.q, lane, std::array::from_fn(|joint| f64::from(q[joint]) + half * dq[joint]));
        set(&mut state.dq, lane, dq);
        set(&mut self.tau, lane, [0.0; 12]);
        let Impulses { points, limits, frictions } = &mut self.impulses;
        let impulses = points.iter_mut().flatten().chain(limits.iter_mut().flatten()).chain(frictions);
        impulses.for_each(|impulse| impulse.set(lane, 0.0));
    }

    /// Replays the actuator periods before the initial state into the state of the actuators.
    ///
    /// `past` has one entry per lane; a period has `steps` physics steps. A robot without history was at rest.
    pub fn replay_history(&mut self, past: &[&[HistoryStep]], steps: usize) {
        if !self.actuator.has_memory() {
            return;
        }
        let zero = T::splat(0.0);
        let q = self.sampled_q();
        let still = std::array::from_fn(|joint| self.actuator.encoder_reading(joint, q[joint], zero).0);
        for age in (0..past.iter().map(|past| past.len()).max().unwrap_or(0)).rev() {
            let (mut q, mut dq) = (still, [zero; 12]);
            let mut commands = SimdCommands { q, dq, tau_ff: [zero; 12], kp: [zero; 12], kd: [zero; 12] };
            for (lane, past) in past.iter().enumerate() {
                let Some(past) = past.len().checked_sub(age + 1).map(|index| &past[index]) else { continue };
                commands.set(lane, &past.command);
                set(&mut q, lane, past.q.map(f64::from));
                set(&mut dq, lane, past.dq.map(f64::from));
            }
            self.actuator.replay_history(&commands, &q, &dq, steps);
        }
    }

    /// Adds `velocity` to the linear velocity of the base of one robot, in the world frame [m/s].
    pub fn push(&mut self, lane: usize, velocity: [f32; 3]) {
        for (component, change) in self.state.linear_velocity.0.iter_mut().zip(velocity) {
            component.set(lane, component.get(lane) + f64::from(change));
        }
    }

    /// Sets the factors on the torque of one robot for supply voltage and motor temperature, until its next reset.
    pub fn set_derating(&mut self, lane: usize, factors: &PerJoint) {
        self.actuator.set_derating(lane, factors);
    }

    /// Advances all robots and returns their sensor readings.
    #[inline(always)]
    pub fn advance(
        &mut self,
        input: &ActuatorInput<T>,
        StepCount { actuator_periods, steps }: StepCount,
        scratch: &mut Workspace<T>,
    ) -> SensorReadings<T> {
        let share = T::splat(1.0 / steps as f64);
        for _ in 0..actuator_periods {
            match input {
                ActuatorInput::Commands(commands) => {
                    self.actuator.update_command(commands, &self.sampled_q(), &self.state.dq);
                }
                ActuatorInput::Torques(tau) => self.actuator.set_torque(*tau),
                ActuatorInput::Residual(commands, tap, tau) => {
                    self.actuator.update_command(commands, &self.sampled_q(), &self.state.dq);
                    self.actuator.set_residual(*tap, *tau);
                }
            }
            self.tau = [T::splat(0.0); 12];
            for index in 0..steps {
                self.step(index, scratch);
                for joint in 0..12 {
                    self.tau[joint] += self.actuator.estimated_torque()[joint] * share;
                }
            }
        }
        self.sample()
    }

    /// Advances by physics step `index` of the actuator period.
    #[inline(always)]
    fn step(&mut self, index: usize, Workspace { factored, constraints }: &mut Workspace<T>) {
        let Self { tree, actuator, state, surface, impulses, dt, .. } = self;
        let forces = actuator.step(index, &state.q, &state.dq);
        let load = JointLoad { tau: forces.tau, damping: forces.damping };
        factored.set_up(tree, state, &load, *dt, T::splat(GRAVITY), surface.is_floating);
        constraints.detect(factored, state, surface, &forces.dry_friction, impulses, *dt);
        constraints.solve(factored, impulses, surface, &forces.dry_friction, *dt, self.iterations);
        let (trunk, joints) = factored.solution();
        self.integrate(trunk, joints);
    }

    /// Integrates by semi-implicit Euler: velocities first, then positions with the new velocities.
    #[inline(always)]
    fn integrate(&mut self, trunk: [T; 6], joints: [T; 12]) {
        let (dt, moving, state) = (self.dt, self.surface.is_floating, &mut self.state);
        for joint in 0..12 {
            state.dq[joint] += joints[joint];
            state.q[joint] += dt * state.dq[joint];
        }
        let [ax, ay, az, lx, ly, lz] = trunk;
        let axes = state.world_axes();
        let (turn, change) = (Vec3([ax, ay, az]).scaled(moving), Vec3([lx, ly, lz]).scaled(moving));
        state.angular_velocity = state.angular_velocity + turn;
        state.linear_velocity =
            state.linear_velocity + Vec3([axes[0].dot(change), axes[1].dot(change), axes[2].dot(change)]);
        state.position = state.position + state.linear_velocity.scaled(dt);
        state.orientation = integrate_orientation(state.orientation, state.angular_velocity.scaled(dt));
    }

    /// Returns the positions and velocities.
    pub fn state(&self) -> &State<T> {
        &self.state
    }

    /// Returns the sensor readings.
    #[inline(always)]
    pub fn sample(&self) -> SensorReadings<T> {
        let State { position, orientation, linear_velocity, angular_velocity, dq, .. } = &self.state;
        // The base is read half a step back, as the joints in `sampled_q`.
        let back = T::splat(-0.5) * self.dt;
        let mut sample = SensorReadings {
            position: *position + linear_velocity.scaled(back),
            orientation: integrate_orientation(*orientation, angular_velocity.scaled(back)),
            q: self.sampled_q(),
            dq: *dq,
        };
        for joint in 0..12 {
            (sample.q[joint], sample.dq[joint]) =
                self.actuator.encoder_reading(joint, sample.q[joint], sample.dq[joint]);
        }
        sample
    }

    /// Returns the joint positions at the time of a sample [rad].
    ///
    /// Semi-implicit Euler uses the velocity at the end of a step. For a constant acceleration `a` from rest its
    /// position is `a t (t + dt) / 2`, which is too large by `dq dt / 2`. Positions read half a step back are
    /// second-order accurate, and the steps remain stable for stiff contacts and springs.
    #[inline(always)]
    fn sampled_q(&self) -> [T; 12] {
        let back = T::splat(-0.5) * self.dt;
        std::array::from_fn(|joint| self.state.q[joint] + back * self.state.dq[joint])
    }

    /// Returns the gyroscope reading of a robot about an axis [rad/s].
    pub fn gyro(&self, lane: usize, axis: usize) -> f64 {
        self.state.angular_velocity.0[axis].get(lane) + self.gyro_bias.0[axis].get(lane)
    }

    /// Returns the estimated torque, mean over the last actuator period [N·m].
    pub fn tau(&self) -> &[T; 12] {
        &self.tau
    }

    /// Returns the normal force on a foot in the last step [N].
    pub fn foot_force(&self, lane: usize, leg: usize) -> f64 {
        self.impulses.points[leg * LEG_POINTS][0].get(lane) / self.dt.get(lane)
    }

    /// Returns true if the trunk or a knee touches the ground.
    pub fn body_contact(&self, lane: usize) -> bool {
        (0..POINTS)
            .filter(|point| *point >= 4 * LEG_POINTS || *point % LEG_POINTS == LEG_POINTS - 1)
            .any(|point| self.impulses.points[point][0].get(lane) > 0.0)
    }

    /// Returns the state of one robot. Takes `&mut self` because `visit` also serves [`RobotBatch::restore`].
    pub fn snapshot(&mut self, lane: usize) -> LaneSnapshot {
        let mut values = Vec::with_capacity(512);
        self.visit(|value| values.push(value.get(lane)));
        LaneSnapshot(values)
    }

    /// Restores the state of one robot.
    pub fn restore(&mut self, lane: usize, snapshot: &LaneSnapshot) {
        let mut values = snapshot.0.iter();
        self.visit(|value| value.set(lane, *values.next().expect("a snapshot of a batch of the same type")));
        self.actuator.restored();
    }

    /// Visits every number that differs between robots, always in the same order.
    fn visit(&mut self, mut visit: impl FnMut(&mut T)) {
        let Self { tree, actuator, surface, state, tau, gyro_bias, impulses, .. } = self;
        let KinematicTree { trunk, bodies, hip, thigh, calf, armature } = tree;
        for body in std::iter::once(trunk).chain(bodies.iter_mut().flatten()) {
            visit(&mut body.mass);
            body.moment.0.iter_mut().chain(&mut body.about_origin).for_each(&mut visit);
        }
        let origins = hip.iter_mut().chain(thigh).chain(calf);
        origins.flat_map(|origin| &mut origin.0).for_each(&mut visit);
        armature.iter_mut().chain(&mut gyro_bias.0).for_each(&mut visit);
        actuator.visit(&mut visit);
        visit(&mut surface.friction);
        visit(&mut surface.time_constant);
        let State { position, orientation, linear_velocity, angular_velocity, q, dq } = state;
        position.0.iter_mut().chain(orientation).chain(&mut linear_velocity.0).for_each(&mut visit);
        angular_velocity.0.iter_mut().chain(q).chain(dq).chain(tau).for_each(&mut visit);
        let Impulses { points, limits, frictions } = impulses;
        points.iter_mut().flatten().chain(limits.iter_mut().flatten()).chain(frictions).for_each(&mut visit);
    }
}

fn set<T: SimdFloat, const N: usize>(values: &mut [T; N], lane: usize, given: [f64; N]) {
    for (value, given) in values.iter_mut().zip(given) {
        value.set(lane, given);
    }
}

fn surface<T: SimdFloat>(robot: &RobotModel, config: &SimConfig, ground: &Ground, dt: f64) -> ContactParams<T> {
    let shapes = &robot.shapes;
    let points = [shapes.foot_centre, shapes.calf_ends[1], shapes.calf_ends[0]].map(Vec3::splat);
    let half = shapes.trunk_half_size;
    let corner = |index: usize| {
        let sign = |bit: usize| if index >> bit & 1 == 0 { -1.0 } else { 1.0 };
        Vec3::splat(half * dvec3(sign(0), sign(1), sign(2)))
    };
    let zero = T::splat(0.0);
    ContactParams {
        leg_points: [points; 4],
        radii: [shapes.foot_radius, shapes.calf_radius, shapes.calf_radius].map(T::splat),
        corners: std::array::from_fn(corner),
        ground: SimdTerrain::new(ground),
        friction: zero,
        time_constant: zero,
        limits: robot.joints.map(|joint| joint.range.map(T::splat)),
        limit_time_constant: T::splat(2.0 * dt),
        is_floating: T::splat(if config.base == BaseMount::Floating { 1.0 } else { 0.0 }),
    }
}

/// Rotates `orientation` by the rotation vector `turn` [rad] in the body frame.
///
/// Uses a Taylor series of the exponential map to the third order, then normalises.
#[inline(always)]
fn integrate_orientation<T: SimdFloat>(orientation: [T; 4], turn: Vec3<T>) -> [T; 4] {
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
