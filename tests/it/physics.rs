//! Comparison of an engine with closed forms and conservation laws. Included once per engine, as its `TestedBackend`.

use std::f32::consts::PI;

use glam::{DMat3, DVec3, Vec3};
use proptest::prelude::*;
use twinstep_dynamics::Vec3 as LaneVec3;
use twinstep_dynamics::quadruped::{Acceleration, KinematicTree, QuadrupedState, forward_dynamics};
use twinstep_envs::Randomisation;
use twinstep_model::{
    Backend, BaseMount, Command, InitialState, Joint, NUM_JOINTS, PerJoint, Restorable, RobotModel, RobotStates,
    Simulator, frames, go2, stream,
};
use twinstep_sim::{Engine, SimConfig, Terrain};

use super::{ENGINE, TestedBackend};

const GRAVITY: f32 = 9.81;
/// Step of the reference integration [s].
const DT: f64 = 1e-5;
/// The joint `FL_calf`.
const CALF: usize = 2;

fn backend(config: SimConfig, initial_state: InitialState) -> TestedBackend {
    let mut backend = TestedBackend::new(go2(), SimConfig { engine: ENGINE, threads: 1, ..config }, 1).unwrap();
    backend.reset(&[(0, initial_state)]).unwrap();
    backend
}

fn zero_gains() -> Command {
    Command::hold([0.0; NUM_JOINTS], 0.0, 0.0)
}

fn default_pose() -> PerJoint {
    go2().control.default_pose_f32()
}

fn hold_default_pose() -> Command {
    let control = go2().control;
    control.hold(default_pose())
}

fn run(backend: &mut TestedBackend, command: &Command, seconds: f32) {
    let periods = (seconds * go2().control.actuator_hz as f32).round() as usize;
    backend.step(&[*command], &[true], periods).unwrap();
}

/// Returns momentum, angular momentum about the world origin and centre of mass of the robot, from its state.
fn momentum(robot: &RobotModel, backend: &TestedBackend) -> (DVec3, DVec3, DVec3) {
    let (linear, angular, com, _) = motion(robot, backend);
    (linear, angular, com)
}

/// Returns the quantities of [`momentum`] and the sum of kinetic and potential energy [J].
fn motion(robot: &RobotModel, backend: &TestedBackend) -> (DVec3, DVec3, DVec3, f64) {
    let states = backend.states();
    let rotation = frames::world_from_base(states.measured.orientation[0]).as_dquat();
    let origin = Vec3::from(states.truth.base_position[0]).as_dvec3();
    let velocity = Vec3::from(states.truth.base_linear_velocity[0]).as_dvec3();
    let spin = rotation * Vec3::from(states.measured.gyro[0]).as_dvec3();
    let (mut linear, mut angular, mut first_moment) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
    let rotors =
        robot.joints.iter().zip(states.measured.dq[0]).map(|(joint, dq)| 0.5 * joint.armature * f64::from(dq).powi(2));
    let mut energy: f64 = rotors.sum();
    let mut add =
        |body: &twinstep_model::RigidBody, rotation: glam::DQuat, origin: DVec3, velocity: DVec3, spin: DVec3| {
            let offset = rotation * body.com;
            let (com, com_velocity) = (origin + offset, velocity + spin.cross(offset));
            let axes = DMat3::from_quat(rotation);
            linear += body.mass * com_velocity;
            let own_spin = axes * body.inertia * axes.transpose() * spin;
            angular += body.mass * com.cross(com_velocity) + own_spin;
            energy += 0.5 * body.mass * com_velocity.length_squared() + 0.5 * spin.dot(own_spin);
            energy += body.mass * f64::from(GRAVITY) * com.z;
            first_moment += body.mass * com;
        };
    add(&robot.trunk, rotation, origin, velocity, spin);
    for (leg, model) in robot.legs.iter().enumerate() {
        let (mut rotation, mut origin, mut velocity, mut spin) = (rotation, origin, velocity, spin);
        for kind in 0..3 {
            let joint = 3 * leg + kind;
            let offset = rotation * model.origins[kind];
            velocity += spin.cross(offset);
            origin += offset;
            let axis = RobotModel::axis(Joint::ALL[joint]);
            spin += rotation * axis * f64::from(states.measured.dq[0][joint]);
            rotation *= glam::DQuat::from_axis_angle(axis, f64::from(states.measured.q[0][joint]));
            add(&model.bodies[kind], rotation, origin, velocity, spin);
        }
    }
    (linear, angular, first_moment / robot.total_mass(), energy)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn unactuated_robot_in_flight_conserves_momentum_and_energy(
        spin in prop::array::uniform3(-2.0f32..2.0),
        dq in prop::array::uniform12(-2.0f32..2.0),
    ) {
        let robot = go2();
        let initial_state =
            InitialState { base_angular_velocity: spin, dq, ..InitialState::at_rest(20.0, default_pose()) };
        let mut backend = backend(SimConfig { physics_hz: Some(4000), ..SimConfig::default() }, initial_state);
        let (linear, angular, com, energy) = motion(&robot, &backend);
        run(&mut backend, &zero_gains(), 0.1);
        let (linear_after, angular_after, com_after, energy_after) = motion(&robot, &backend);
        let gravity_impulse = DVec3::new(0.0, 0.0, -9.81 * robot.total_mass() * 0.1);
        prop_assert!((linear_after - linear - gravity_impulse).length() < 0.01);
        let about_com = |angular: DVec3, com: DVec3, linear: DVec3| angular - com.cross(linear);
        let change = about_com(angular_after, com_after, linear_after) - about_com(angular, com, linear);
        prop_assert!(change.length() < 0.01);
        let kinetic = energy - robot.total_mass() * f64::from(GRAVITY) * com.z;
        prop_assert!((energy_after - energy).abs() < 0.01 * kinetic + 0.1, "{energy} J, then {energy_after} J");
    }
}

#[test]
fn dropped_robot_falls_with_gravity() {
    let mut backend = backend(
        SimConfig { physics_hz: Some(400), solver_iterations: Some(1), ..SimConfig::default() },
        InitialState::at_rest(10.0, default_pose()),
    );
    run(&mut backend, &hold_default_pose(), 1.0);
    let fallen = 10.0 - backend.states().truth.base_position[0][2];
    // Semi-implicit Euler falls g·dt·t/2 too far, 12 mm at 400 Hz. The batch engine subtracts this from the positions
    // that it reports. The tolerance covers the motion of the trunk relative to the centre of mass.
    let excess = if ENGINE == Engine::Rapier { 0.01226 } else { 0.0 };
    assert!((fallen - GRAVITY / 2.0 - excess).abs() < 0.004, "fell {fallen} m");
    assert!((backend.states().truth.base_linear_velocity[0][2] + GRAVITY).abs() < 0.02);
}

#[test]
fn momentum_is_conserved_in_flight_while_the_legs_swing() {
    let robot = go2();
    let initial_state = InitialState {
        base_linear_velocity: [0.3, -0.2, 5.0],
        base_angular_velocity: [1.0, 1.5, -0.8],
        ..InitialState::at_rest(20.0, default_pose())
    };
    let mut backend = backend(SimConfig { physics_hz: Some(1000), ..SimConfig::default() }, initial_state);
    let (linear, _, com) = momentum(&robot, &backend);
    let about_com = |backend: &TestedBackend| {
        let (linear, angular, com) = momentum(&robot, backend);
        angular - com.cross(linear)
    };
    let spin = about_com(&backend);
    for period in 0..200 {
        let swing = (period as f32 * 0.01 * PI).sin() * 0.4;
        let command = Command::hold(default_pose().map(|q| q + swing), 30.0, 0.75);
        backend.step(&[command], &[true], 1).unwrap();
    }
    let gravity_impulse = DVec3::new(0.0, 0.0, -9.81 * robot.total_mass());
    let (linear_after, _, com_after) = momentum(&robot, &backend);
    assert!((linear_after - linear - gravity_impulse).length() < 0.02, "{linear_after} after {linear}");
    assert!((about_com(&backend) - spin).length() < 0.02, "{} after {spin}", about_com(&backend));
    let displacement = com_after - com;
    let ballistic = linear / robot.total_mass() - DVec3::new(0.0, 0.0, 9.81 / 2.0);
    // With a root frame that is not at the centre of mass, the error would be 0.04 m.
    assert!((displacement - ballistic).length() < 0.008, "moved {displacement}, ballistic {ballistic}");
}

#[test]
fn torque_step_accelerates_the_calf_by_its_inertia() {
    let robot = lone_calf(0.0, 0.0);
    let closed_form = 0.5 * 0.02 / calf_inertia(&robot);
    let gained = calf_velocity(&robot, 0.0, 0.5);
    assert!((gained / closed_form - 1.0).abs() < 0.005, "{gained} rad/s, closed form {closed_form}");
}

/// Returns a robot of which only the joint `CALF` moves, with this friction.
///
/// The other joints have such a high rotor inertia that they do not move.
fn lone_calf(viscous: f64, coulomb: f64) -> RobotModel {
    let mut robot = go2();
    for (joint, model) in robot.joints.iter_mut().enumerate() {
        if joint == CALF {
            (model.viscous_friction, model.coulomb_friction) = (viscous, coulomb);
        } else {
            model.armature = 1e4;
        }
    }
    robot
}

/// Returns the velocity of the calf [rad/s] after 20 ms, from an initial velocity [rad/s] and with a torque [N·m].
///
/// It is half the difference between the results for these values and for their negatives, so that gravity cancels.
fn calf_velocity(robot: &RobotModel, dq: f32, tau: f32) -> f64 {
    let config = SimConfig {
        engine: ENGINE,
        base: BaseMount::Fixed,
        physics_hz: Some(4000),
        threads: 1,
        ..SimConfig::default()
    };
    let [forward, backward] = [1.0, -1.0].map(|sign| {
        let mut backend = TestedBackend::new(robot.clone(), config, 1).unwrap();
        let mut initial_state = InitialState::at_rest(2.0, default_pose());
        initial_state.dq[CALF] = sign * dq;
        backend.reset(&[(0, initial_state)]).unwrap();
        let mut command = zero_gains();
        command.tau_ff[CALF] = sign * tau;
        run(&mut backend, &command, 0.02);
        f64::from(backend.measured().dq[0][CALF])
    });
    (forward - backward) / 2.0
}

/// Returns the moment of inertia of the calf about its joint, with its rotor [kg·m²].
fn calf_inertia(robot: &RobotModel) -> f64 {
    let body = &robot.legs[0].bodies[2];
    body.inertia.y_axis.y + body.mass * (body.com.x.powi(2) + body.com.z.powi(2)) + robot.joints[CALF].armature
}

#[test]
fn viscous_friction_slows_the_calf_exponentially() {
    let robot = lone_calf(0.3, 0.0);
    let closed_form = 5.0 * (-0.3 * 0.02 / calf_inertia(&robot)).exp();
    let slowed = calf_velocity(&robot, 5.0, 0.0);
    assert!((slowed / closed_form - 1.0).abs() < 0.01, "{slowed} rad/s, closed form {closed_form}");
}

#[test]
fn coulomb_friction_reduces_the_torque_on_a_moving_calf() {
    let robot = lone_calf(0.0, 0.4);
    let closed_form = 2.0 + (1.0 - 0.4) * 0.02 / calf_inertia(&robot);
    let gained = calf_velocity(&robot, 2.0, 1.0);
    assert!((gained / closed_form - 1.0).abs() < 0.01, "{gained} rad/s, closed form {closed_form}");
}

#[test]
fn coulomb_friction_balances_smaller_torques() {
    let config = SimConfig { engine: ENGINE, base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let angle_after = |tau: f32| {
        let mut backend = TestedBackend::new(lone_calf(0.0, 0.8), config, 1).unwrap();
        backend.reset(&[(0, InitialState::at_rest(2.0, default_pose()))]).unwrap();
        let mut command = zero_gains();
        command.tau_ff[CALF] = tau;
        run(&mut backend, &command, 1.0);
        (backend.measured().q[0][CALF] - default_pose()[CALF]).abs()
    };
    // The torque due to gravity is 0.2 N·m.
    assert!(angle_after(0.4) < 1e-3, "moved by {} rad", angle_after(0.4));
    assert!(angle_after(1.5) > 0.5, "moved by {} rad", angle_after(1.5));
}

/// The reference integrates the equations of motion over 5 ms of flight in double precision with steps of 10 µs.
#[test]
fn acceleration_agrees_with_the_equations_of_motion() {
    let tree = KinematicTree::<f64>::splat(&go2());
    let initial_state = InitialState {
        base_linear_velocity: [0.3, -0.2, 1.0],
        base_angular_velocity: [1.0, 1.5, -0.8],
        dq: std::array::from_fn(|joint| (joint as f32 - 5.0) * 0.5),
        ..InitialState::at_rest(20.0, default_pose())
    };
    let mut command = zero_gains();
    command.tau_ff = std::array::from_fn(|joint| ((joint * 7 % 12) as f32 - 5.5) * 0.8);
    let mut backend = backend(SimConfig { physics_hz: Some(4000), ..SimConfig::default() }, initial_state);
    backend.step(&[command], &[true], 1).unwrap();

    let mut state = QuadrupedState::<f64> {
        linear_velocity: LaneVec3(initial_state.base_linear_velocity.map(f64::from)),
        angular_velocity: LaneVec3(initial_state.base_angular_velocity.map(f64::from)),
        q: initial_state.q.map(f64::from),
        dq: initial_state.dq.map(f64::from),
        ..QuadrupedState::origin(NUM_JOINTS)
    };
    for _ in 0..500 {
        let Acceleration { angular, linear, ddq } =
            forward_dynamics(&tree, &state, &command.tau_ff.map(f64::from), f64::from(GRAVITY));
        let [w, x, y, z] = state.orientation;
        let rotation = glam::DQuat::from_xyzw(x, y, z, w);
        let velocity_change = rotation * DVec3::from(linear.0) * DT;
        state.linear_velocity = state.linear_velocity + LaneVec3(velocity_change.to_array());
        state.angular_velocity = state.angular_velocity + angular.scaled(DT);
        let turned = rotation * glam::DQuat::from_scaled_axis(DVec3::from(state.angular_velocity.0) * DT);
        state.orientation = [turned.w, turned.x, turned.y, turned.z];
        for ((q, dq), ddq) in state.q.iter_mut().zip(&mut state.dq).zip(ddq) {
            *dq += DT * ddq;
            *q += DT * *dq;
        }
    }
    let states = backend.states();
    for joint in 0..NUM_JOINTS {
        let (engine, exact) = (f64::from(states.measured.dq[0][joint]), state.dq[joint]);
        assert!((engine - exact).abs() < 0.01 + 0.01 * exact.abs(), "joint {joint}: {engine} and {exact} rad/s");
    }
    for axis in 0..3 {
        let (engine, exact) = (f64::from(states.measured.gyro[0][axis]), state.angular_velocity.0[axis]);
        assert!((engine - exact).abs() < 0.01, "{engine} and {exact} rad/s");
        let (engine, exact) = (f64::from(states.truth.base_linear_velocity[0][axis]), state.linear_velocity.0[axis]);
        assert!((engine - exact).abs() < 0.002, "{engine} and {exact} m/s");
    }
}

#[test]
fn foot_forces_of_a_standing_robot_equal_its_weight_and_it_does_not_drift() {
    let robot = go2();
    let mut backend = backend(SimConfig::default(), InitialState::at_rest(0.33, default_pose()));
    let stiff = Command::hold(default_pose(), 60.0, 2.0);
    run(&mut backend, &stiff, 5.0);
    let (start, weight) = (backend.states().truth.base_position[0], robot.total_mass() as f32 * GRAVITY);
    run(&mut backend, &stiff, 60.0);
    let states = backend.states();
    let force: f32 = states.truth.foot_force[0].iter().sum();
    assert!((force / weight - 1.0).abs() < 0.002, "{force} N on the feet, weight {weight} N");
    let drift = (Vec3::from(states.truth.base_position[0]) - Vec3::from(start)).length();
    assert!(drift < 0.01, "drifted {drift} m in a minute");
    assert!(!states.truth.body_contact[0]);
    assert!(frames::projected_gravity(states.measured.orientation[0]).z < -0.99);
}

#[test]
fn robot_on_a_slope_slides_only_beyond_the_friction_angle() {
    let friction = go2().contact.friction as f32;
    let slip = |angle: f32| {
        let config = SimConfig { physics_hz: Some(1000), terrain: Terrain::SlopeRad(angle), ..SimConfig::default() };
        // A stiff crouch, so that the robot slides before it tips over.
        let crouch: PerJoint = Joint::map_kinds(0.0, 1.3, -2.6);
        let initial_state = InitialState {
            base_orientation: frames::to_wxyz(glam::Quat::from_rotation_y(-angle)),
            ..InitialState::at_rest(0.16 / angle.cos(), crouch)
        };
        let mut backend = backend(config, initial_state);
        let hold = Command::hold(crouch, 200.0, 5.0);
        run(&mut backend, &hold, 0.5);
        let before = Vec3::from(backend.states().truth.base_position[0]);
        run(&mut backend, &hold, 0.5);
        (Vec3::from(backend.states().truth.base_position[0]) - before).length()
    };
    let limit = friction.atan();
    assert!(slip(limit - 0.1) < 0.01, "below the friction angle: {} m", slip(limit - 0.1));
    assert!(slip(limit + 0.1) > 0.1, "above the friction angle: {} m", slip(limit + 0.1));
}

fn trot_bits(threads: usize) -> Vec<u32> {
    let robots = 7;
    let mut backend = TestedBackend::new(go2(), SimConfig { threads, ..SimConfig::default() }, robots).unwrap();
    for period in 0..100 {
        let commands: Vec<Command> = (0..robots)
            .map(|robot| {
                let swing = ((period + robot) as f32 * 0.06).sin() * 0.3;
                Command::hold(default_pose().map(|q| q + swing), 30.0, 0.75)
            })
            .collect();
        backend.step(&commands, &vec![true; robots], 1).unwrap();
    }
    let states = backend.states();
    states
        .measured
        .q
        .iter()
        .flatten()
        .chain(states.truth.base_position.iter().flatten())
        .map(|value| value.to_bits())
        .collect()
}

#[test]
fn result_is_bitwise_independent_of_the_number_of_threads() {
    assert_eq!(trot_bits(1), trot_bits(2));
}

#[test]
fn restored_robot_continues_bitwise_identically() {
    let mut backend = backend(SimConfig::default(), InitialState::at_rest(0.33, default_pose()));
    run(&mut backend, &hold_default_pose(), 0.3);
    let snapshot = backend.snapshot(0);
    let command = Command::hold(default_pose().map(|q| q + 0.2), 30.0, 0.75);
    run(&mut backend, &command, 0.5);
    let first = backend.states().clone();
    backend.restore(0, &snapshot);
    run(&mut backend, &command, 0.5);
    assert_eq!(backend.states(), &first);
}

#[test]
fn inactive_robot_does_not_move() {
    let mut backend = TestedBackend::new(go2(), SimConfig::default(), 2).unwrap();
    let before = backend.states().clone();
    backend.step(&[zero_gains(); 2], &[false, true], 20).unwrap();
    assert_eq!(backend.measured().q[0], before.measured.q[0]);
    assert_ne!(backend.measured().q[1], before.measured.q[1]);
}

#[test]
fn foot_forces_include_payload_and_mass_scale() {
    let initial_state = InitialState::at_rest(0.33, default_pose());
    let mut backend = backend(SimConfig::default(), initial_state);
    let randomise = Randomisation { mass_scale: [1.1; 2], payload_kg: [3.0; 2], ..Randomisation::default() };
    let model = randomise.sample(&go2(), &mut stream(0, "test", 0)).unwrap();
    backend.reset_with_model(0, &model, &initial_state).unwrap();
    run(&mut backend, &Command::hold(default_pose(), 80.0, 3.0), 4.0);
    let force: f32 = backend.states().truth.foot_force[0].iter().sum();
    let weight = (go2().total_mass() as f32 * 1.1 + 3.0) * GRAVITY;
    assert!((force / weight - 1.0).abs() < 0.005, "{force} N, weight {weight} N");
}

#[test]
fn push_adds_its_velocity_to_every_body_of_the_robot() {
    let mut initial_state = InitialState::at_rest(1.0, default_pose().map(|q| q + 0.1));
    initial_state.base_angular_velocity = [0.5, -0.3, 0.8];
    initial_state.dq = std::array::from_fn(|joint| 0.3 * joint as f32 - 2.0);
    let mut backend = backend(SimConfig::default(), initial_state);
    let before = backend.states().clone();
    let (linear, ..) = momentum(&go2(), &backend);
    let velocity = [0.4, -0.3, 0.1];
    backend.push(0, velocity).unwrap();
    let after = backend.states();
    let change = |quantity: fn(&RobotStates) -> [f32; 3]| Vec3::from(quantity(after)) - Vec3::from(quantity(&before));
    let linear_change = change(|states| states.truth.base_linear_velocity[0]);
    assert!((linear_change - Vec3::from(velocity)).length() < 1e-5, "{linear_change}");
    let angular_change = change(|states| states.truth.base_angular_velocity[0]);
    assert!(angular_change.length() < 1e-5, "{angular_change}");
    let change = momentum(&go2(), &backend).0 - linear;
    let expected = Vec3::from(velocity).as_dvec3() * go2().total_mass();
    assert!((change - expected).length() < 1e-3, "{change} {expected}");
}

#[test]
fn fixed_base_cannot_be_pushed() {
    let config = SimConfig { base: BaseMount::Fixed, ..SimConfig::default() };
    let mut backend = backend(config, InitialState::at_rest(1.0, default_pose()));
    let error = backend.push(0, [0.5, 0.0, 0.0]).unwrap_err();
    assert_eq!(error.to_string(), "robot 0 cannot be pushed: its base is fixed");
}
