//! State of the robots in one SIMD register, and one physics step of them.

use twinstep_dynamics::{JointValues, SimdActuators, SimdCommands, State, StepEquations, Vec3, link_armature};
use twinstep_model::{Ground, HistoryStep};
use twinstep_simd::SimdFloat;

use super::batch_robot::BatchRobot;
use super::contact::{Impulses, Step};
use super::surface::ContactParams;
use super::workspace::{Workspace, WorkspaceShape};
use crate::actuator_input::ActuatorInput;
use crate::{Placement, SimConfig};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

/// State of the robots in one SIMD register, one per lane, with the equations of motion `E`.
pub struct RobotBatch<T: SimdFloat, E: StepEquations<T>> {
    parameters: E::Parameters,
    actuator: SimdActuators<T, E::Joints>,
    surface: ContactParams<T>,
    state: State<T, E::Joints>,
    /// Joint positions at the time of a sample [rad or m]: see [`RobotBatch::sampled_position`].
    sampled_q: E::Joints,
    /// Velocity changes of the joints in a step.
    changes: E::Joints,
    /// Estimated torque, mean over the last actuator period [N·m or N].
    tau: E::Joints,
    /// Gyroscope bias [rad/s].
    gyro_bias: Vec3<T>,
    impulses: Impulses<T>,
    dt: T,
    iterations: usize,
}

impl<T: SimdFloat, E: StepEquations<T>> Clone for RobotBatch<T, E> {
    fn clone(&self) -> Self {
        Self {
            parameters: self.parameters.clone(),
            actuator: self.actuator.clone(),
            surface: self.surface.clone(),
            state: self.state.clone(),
            sampled_q: self.sampled_q.clone(),
            changes: self.changes.clone(),
            tau: self.tau.clone(),
            gyro_bias: self.gyro_bias,
            impulses: self.impulses.clone(),
            dt: self.dt,
            iterations: self.iterations,
        }
    }
}

/// Number of steps to advance by.
#[derive(Clone, Copy)]
pub struct StepCount {
    /// Actuator periods.
    pub actuator_periods: usize,
    /// Physics steps per actuator period.
    pub steps: usize,
}

/// Sensor readings of all robots.
pub struct SensorReadings<T, J> {
    /// Position of the base [m].
    pub position: Vec3<T>,
    /// Orientation of the base, world-from-base.
    pub orientation: [T; 4],
    /// Encoder positions [rad or m].
    pub q: J,
    /// Encoder velocities [rad/s or m/s].
    pub dq: J,
}

/// State of one robot of a batch: its lane of every number.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneSnapshot(Vec<f64>);

impl<T: SimdFloat, E: StepEquations<T, Robot: BatchRobot>> RobotBatch<T, E> {
    /// Creates robots whose actuators have the period `actuator_dt` [s] in a state.
    pub fn new(
        robot: &E::Robot,
        actuator_dt: f64,
        config: &SimConfig,
        ground: &Ground,
        initial_state: &Placement,
    ) -> Self {
        let (dt, num_joints) = (1.0 / f64::from(config.physics_hz()), robot.joints().len());
        let surface = ContactParams::new::<E>(robot, config, ground, dt);
        let zero = E::Joints::filled(num_joints, T::splat(0.0));
        let mut group = Self {
            parameters: E::parameters(robot),
            actuator: SimdActuators::new(robot.joints(), actuator_dt, dt),
            state: State::origin(num_joints),
            sampled_q: zero.clone(),
            changes: zero.clone(),
            tau: zero,
            gyro_bias: Vec3::splat(robot.gyro_bias()),
            impulses: Impulses::zero(surface.num_contacts(), num_joints),
            surface,
            dt: T::splat(dt),
            iterations: config.solver_iterations() as usize,
        };
        for lane in 0..T::LANES {
            group.place(lane, robot, initial_state);
        }
        group
    }

    /// Returns what the workspaces of batches like this one have in common.
    pub fn workspace_shape(&self) -> WorkspaceShape<T, E> {
        let each = self.surface.ground.contacts_of_point();
        let bodies = self.surface.bodies.iter();
        let bodies = bodies.flat_map(|of_body| std::iter::repeat_n(of_body.body, each * of_body.points.len()));
        WorkspaceShape {
            parameters: self.parameters.clone(),
            bodies: bodies.collect(),
            num_joints: self.tau.as_ref().len(),
        }
    }

    /// Resets one robot to an initial state.
    pub fn place(&mut self, lane: usize, robot: &E::Robot, initial_state: &Placement) {
        E::set_robot(&mut self.parameters, lane, robot);
        // An initial state contains encoder readings.
        let joints = robot.joints().iter().enumerate();
        let q: Vec<f64> = joints
            .map(|(index, joint)| initial_state.q[index] - joint.actuator.encoder_error(initial_state.dq[index]))
            .collect();
        self.actuator.set(lane, robot.joints(), &q, &initial_state.dq);
        for (armature, joint) in E::armature(&mut self.parameters).as_mut().iter_mut().zip(robot.joints()) {
            armature.set(lane, link_armature(joint));
        }
        self.gyro_bias.set(lane, robot.gyro_bias());
        self.surface.friction.set(lane, robot.contact().friction);
        self.surface.base_friction.set(lane, robot.base_friction() * self.surface.is_floating.get(lane));
        // At least two steps, below which the constraint is unstable (MuJoCo's `refsafe`).
        self.surface.time_constant.set(lane, robot.contact().time_constant.max(2.0 * self.dt.get(lane)));

        // `sample_positions` reads positions half a step back, so they are set half a step ahead.
        let half = 0.5 * self.dt.get(lane);
        let moving = self.surface.is_floating.get(lane);
        let [linear, angular] = [initial_state.base_linear_velocity, initial_state.base_angular_velocity]
            .map(|given| Vec3(given.map(|value| moving * value)));
        let position = Vec3(initial_state.base_position) + linear.scaled(half);
        let state = &mut self.state;
        set(&mut state.position.0, lane, position.0);
        let turned = integrate_orientation(initial_state.base_orientation, angular.scaled(half));
        set(&mut state.orientation, lane, turned);
        set(&mut state.linear_velocity.0, lane, linear.0);
        set(&mut state.angular_velocity.0, lane, angular.0);
        for (joint, (q, dq)) in q.iter().zip(&initial_state.dq).enumerate() {
            state.q[joint].set(lane, q + half * dq);
            state.dq[joint].set(lane, *dq);
            self.tau[joint].set(lane, 0.0);
        }
        self.impulses.all_mut().for_each(|impulse| impulse.set(lane, 0.0));
    }

    /// Replays the actuator periods before the initial state into the state of the actuators.
    ///
    /// `past` has one entry per lane; a period has `steps` physics steps. A robot without history was at rest.
    pub fn replay_history(&mut self, past: &[&[HistoryStep]], steps: usize) {
        if !self.actuator.has_memory() {
            return;
        }
        self.sample_positions();
        let (zero, mut still) = (E::Joints::filled(self.tau.as_ref().len(), T::splat(0.0)), self.sampled_q.clone());
        for (joint, still) in still.as_mut().iter_mut().enumerate() {
            *still = self.actuator.encoder_reading(joint, *still, T::splat(0.0)).0;
        }
        for age in (0..past.iter().map(|past| past.len()).max().unwrap_or(0)).rev() {
            let (mut q, mut dq) = (still.clone(), zero.clone());
            let mut commands = SimdCommands::zero(zero.as_ref().len());
            commands.q = q.clone();
            for (lane, past) in past.iter().enumerate() {
                let Some(past) = past.len().checked_sub(age + 1).map(|index| &past[index]) else { continue };
                commands.set(lane, &past.command);
                set(q.as_mut(), lane, past.q.map(f64::from));
                set(dq.as_mut(), lane, past.dq.map(f64::from));
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
    pub fn set_derating(&mut self, lane: usize, factors: &[f32]) {
        self.actuator.set_derating(lane, factors);
    }

    /// Advances all robots and returns their sensor readings.
    #[inline(always)]
    pub fn advance(
        &mut self,
        input: &ActuatorInput<E::Joints>,
        StepCount { actuator_periods, steps }: StepCount,
        scratch: &mut Workspace<T, E>,
    ) -> SensorReadings<T, E::Joints> {
        let share = T::splat(1.0 / steps as f64);
        for _ in 0..actuator_periods {
            match input {
                ActuatorInput::Commands(commands) => {
                    self.sample_positions();
                    self.actuator.update_command(commands, &self.sampled_q, &self.state.dq);
                }
                ActuatorInput::Torques(tau) => self.actuator.set_torque(tau),
                ActuatorInput::Residual(commands, tap, tau) => {
                    self.sample_positions();
                    self.actuator.update_command(commands, &self.sampled_q, &self.state.dq);
                    self.actuator.set_residual(*tap, tau.clone());
                }
            }
            self.tau.as_mut().fill(T::splat(0.0));
            for index in 0..steps {
                self.step(index, scratch);
                let estimated = self.actuator.estimated_torque().as_ref();
                for (tau, estimated) in self.tau.as_mut().iter_mut().zip(estimated) {
                    *tau += *estimated * share;
                }
            }
        }
        self.sample()
    }

    /// Advances by physics step `index` of the actuator period.
    #[inline(always)]
    fn step(&mut self, index: usize, Workspace { equations, constraints }: &mut Workspace<T, E>) {
        let Self { parameters, actuator, state, surface, impulses, dt, .. } = self;
        actuator.step(index, &state.q, &state.dq);
        let forces = actuator.forces();
        equations.set_up(parameters, state, forces, *dt, T::splat(GRAVITY), surface.is_floating);
        let step = Step { equations: &*equations, state, surface, dt: *dt };
        constraints.detect(&step, &forces.dry_friction, impulses);
        constraints.solve(equations, impulses, surface, &forces.dry_friction, *dt, self.iterations);
        let base = equations.solution(&mut self.changes);
        self.integrate(base);
    }

    /// Integrates by semi-implicit Euler: velocities first, then positions with the new velocities.
    #[inline(always)]
    fn integrate(&mut self, [ax, ay, az, lx, ly, lz]: [T; 6]) {
        let (dt, moving, state) = (self.dt, self.surface.is_floating, &mut self.state);
        for joint in 0..self.changes.as_ref().len() {
            state.dq[joint] += self.changes[joint];
            let speed = state.dq[joint];
            state.q[joint] += dt * speed;
        }
        let axes = state.world_axes();
        let (turn, change) = (Vec3([ax, ay, az]).scaled(moving), Vec3([lx, ly, lz]).scaled(moving));
        state.angular_velocity = state.angular_velocity + turn;
        state.linear_velocity =
            state.linear_velocity + Vec3([axes[0].dot(change), axes[1].dot(change), axes[2].dot(change)]);
        state.position = state.position + state.linear_velocity.scaled(dt);
        state.orientation = integrate_orientation(state.orientation, state.angular_velocity.scaled(dt));
    }

    /// Returns the positions and velocities.
    pub fn state(&self) -> &State<T, E::Joints> {
        &self.state
    }

    /// Returns the sensor readings.
    #[inline(always)]
    pub fn sample(&self) -> SensorReadings<T, E::Joints> {
        let State { position, orientation, linear_velocity, angular_velocity, dq, .. } = &self.state;
        // The base is read half a step back, as the joints.
        let back = T::splat(-0.5) * self.dt;
        let mut sample = SensorReadings {
            position: *position + linear_velocity.scaled(back),
            orientation: integrate_orientation(*orientation, angular_velocity.scaled(back)),
            q: dq.clone(),
            dq: dq.clone(),
        };
        for joint in 0..dq.as_ref().len() {
            (sample.q[joint], sample.dq[joint]) =
                self.actuator.encoder_reading(joint, self.sampled_position(joint), dq[joint]);
        }
        sample
    }

    /// Computes the joint positions at the time of a sample.
    #[inline(always)]
    fn sample_positions(&mut self) {
        for joint in 0..self.sampled_q.as_ref().len() {
            self.sampled_q[joint] = self.sampled_position(joint);
        }
    }

    /// Returns the position of a joint at the time of a sample [rad or m].
    ///
    /// Semi-implicit Euler uses the velocity at the end of a step. For a constant acceleration `a` from rest its
    /// position is `a t (t + dt) / 2`, which is too large by `dq dt / 2`. Positions read half a step back are
    /// second-order accurate, and the steps remain stable for stiff contacts and springs.
    #[inline(always)]
    fn sampled_position(&self, joint: usize) -> T {
        self.state.q[joint] + T::splat(-0.5) * self.dt * self.state.dq[joint]
    }

    /// Returns the gyroscope reading of a robot about an axis [rad/s].
    pub fn gyro(&self, lane: usize, axis: usize) -> f64 {
        self.state.angular_velocity.0[axis].get(lane) + self.gyro_bias.0[axis].get(lane)
    }

    /// Returns the estimated torque, mean over the last actuator period [N·m or N].
    pub fn tau(&self) -> &E::Joints {
        &self.tau
    }

    /// Returns the normal force on a contact point in the last step, summed over the faces that it touches [N].
    pub fn point_force(&self, lane: usize, point: usize) -> f64 {
        let each = self.surface.ground.contacts_of_point();
        let contacts = &self.impulses.points[each * point..each * (point + 1)];
        contacts.iter().map(|impulse| impulse[0].get(lane)).sum::<f64>() / self.dt.get(lane)
    }

    /// Returns the number of contact points.
    pub fn num_points(&self) -> usize {
        self.surface.points.len()
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
        let Self { parameters, actuator, surface, state, tau, gyro_bias, impulses, .. } = self;
        E::visit(parameters, &mut visit);
        gyro_bias.0.iter_mut().for_each(&mut visit);
        actuator.visit(&mut visit);
        visit(&mut surface.friction);
        visit(&mut surface.base_friction);
        visit(&mut surface.time_constant);
        let State { position, orientation, linear_velocity, angular_velocity, q, dq } = state;
        position.0.iter_mut().chain(orientation).chain(&mut linear_velocity.0).for_each(&mut visit);
        let joints = q.as_mut().iter_mut().chain(dq.as_mut()).chain(tau.as_mut());
        angular_velocity.0.iter_mut().chain(joints).for_each(&mut visit);
        impulses.all_mut().for_each(visit);
    }
}

fn set<T: SimdFloat, const N: usize>(values: &mut [T], lane: usize, given: [f64; N]) {
    for (value, given) in values.iter_mut().zip(given) {
        value.set(lane, given);
    }
}

/// Rotates `orientation` by the rotation vector `turn` [rad] in the body frame.
///
/// Uses a Taylor series of the exponential map to the fifth order, then normalises.
#[inline(always)]
fn integrate_orientation<T: SimdFloat>(orientation: [T; 4], turn: Vec3<T>) -> [T; 4] {
    let half = turn.scaled(T::splat(0.5));
    let square = half.dot(half);
    let one = T::splat(1.0);
    let [a, b, c] = half.scaled(one - square * T::splat(1.0 / 6.0) * (one - square * T::splat(1.0 / 20.0))).0;
    let d = one - square * T::splat(0.5) * (one - square * T::splat(1.0 / 12.0));
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
