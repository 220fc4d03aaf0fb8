//! Equations of motion compared with finite differences and with each other, in double precision.

use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;

use super::*;
use crate::{Inertia, Vec3};
use twinstep_model::{Pose, RigidBody, RobotModel, body_poses, go2};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

fn numbers<const N: usize>(limit: f64) -> impl Strategy<Value = [f64; N]> {
    prop::array::uniform(-limit..limit)
}

fn state() -> impl Strategy<Value = QuadrupedState<f64>> {
    (numbers::<4>(1.0), numbers::<12>(0.8), numbers::<12>(5.0), numbers::<3>(2.0), numbers::<3>(2.0))
        .prop_filter("an orientation", |(turn, ..)| turn.iter().map(|x| x * x).sum::<f64>() > 0.1)
        .prop_map(|(turn, offset, dq, angular, linear)| {
            let [w, x, y, z] = turn;
            let turn = DQuat::from_xyzw(x, y, z, w).normalize();
            let pose = go2().control.default_pose;
            QuadrupedState {
                position: Vec3([0.3, -0.2, 0.5]),
                orientation: [turn.w, turn.x, turn.y, turn.z],
                linear_velocity: Vec3(linear),
                angular_velocity: Vec3(angular),
                q: std::array::from_fn(|joint| pose[joint] + offset[joint]),
                dq,
            }
        })
}

fn acceleration() -> impl Strategy<Value = Acceleration<f64>> {
    (numbers::<3>(20.0), numbers::<3>(20.0), numbers::<12>(100.0)).prop_map(|(angular, linear, ddq)| Acceleration {
        angular: Vec3(angular),
        linear: Vec3(linear),
        ddq,
    })
}

fn tree() -> KinematicTree<f64> {
    KinematicTree::splat(&go2())
}

fn world_from_base(state: &QuadrupedState<f64>) -> DQuat {
    let [w, x, y, z] = state.orientation;
    DQuat::from_xyzw(x, y, z, w)
}

/// Returns the state after `dt` [s] at constant velocities.
fn moved(state: &QuadrupedState<f64>, dt: f64) -> QuadrupedState<f64> {
    let turn = world_from_base(state) * DQuat::from_scaled_axis(DVec3::from(state.angular_velocity.0) * dt);
    QuadrupedState {
        position: state.position + state.linear_velocity.scaled(dt),
        orientation: [turn.w, turn.x, turn.y, turn.z],
        q: std::array::from_fn(|joint| state.q[joint] + dt * state.dq[joint]),
        ..*state
    }
}

/// Returns the state after `dt` [s] at constant accelerations, to first order.
fn accelerated(state: &QuadrupedState<f64>, acceleration: &Acceleration<f64>, dt: f64) -> QuadrupedState<f64> {
    let later = moved(state, dt);
    let push = world_from_base(state) * DVec3::from(acceleration.linear.0) * dt;
    QuadrupedState {
        linear_velocity: later.linear_velocity + Vec3(push.to_array()),
        angular_velocity: later.angular_velocity + acceleration.angular.scaled(dt),
        dq: std::array::from_fn(|joint| state.dq[joint] + dt * acceleration.ddq[joint]),
        ..later
    }
}

/// Returns each body with its position and rotation in the world frame, by independent kinematics.
fn frames(robot: &RobotModel, state: &QuadrupedState<f64>) -> Vec<(RigidBody, DVec3, DQuat)> {
    let base = (DVec3::from(state.position.0), world_from_base(state));
    let mut frames = vec![(robot.trunk, base.0, base.1)];
    for (leg, model) in robot.legs.iter().enumerate() {
        let (mut position, mut rotation) = base;
        for (joint, axis) in [DVec3::X, DVec3::Y, DVec3::Y].into_iter().enumerate() {
            position += rotation * model.origins[joint];
            rotation *= DQuat::from_axis_angle(axis, state.q[3 * leg + joint]);
            frames.push((model.bodies[joint], position, rotation));
        }
    }
    frames
}

/// Returns the kinetic plus potential energy [J], with the velocities of the bodies by finite differences.
fn energy(robot: &RobotModel, state: &QuadrupedState<f64>) -> f64 {
    const DT: f64 = 1e-6;
    let (before, after) = (frames(robot, &moved(state, -DT)), frames(robot, &moved(state, DT)));
    let here = frames(robot, state);
    let mut energy = 0.0;
    for ((body, position, rotation), (before, after)) in here.iter().zip(before.iter().zip(&after)) {
        let com = |(body, position, rotation): &(RigidBody, DVec3, DQuat)| *position + *rotation * body.com;
        let velocity = (com(after) - com(before)) / (2.0 * DT);
        // Rotation between both states in body axes, by the shorter angle.
        let turn = before.2.inverse() * after.2;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let omega = turn.to_scaled_axis() / (2.0 * DT);
        energy += 0.5 * body.mass * velocity.length_squared() + 0.5 * omega.dot(body.inertia * omega);
        energy += body.mass * GRAVITY * (*position + *rotation * body.com).z;
    }
    let rotors = robot.joints.iter().zip(state.dq).map(|(joint, dq)| 0.5 * joint.armature * dq * dq);
    energy + rotors.sum::<f64>()
}

/// Returns the 18 generalised velocities: angular and linear of the base in base axes, then joints.
fn velocities(state: &QuadrupedState<f64>) -> [f64; 18] {
    let linear = world_from_base(state).inverse() * DVec3::from(state.linear_velocity.0);
    let base = [state.angular_velocity.0, linear.to_array()].concat();
    std::array::from_fn(|i| if i < 6 { base[i] } else { state.dq[i - 6] })
}

fn entries(acceleration: &Acceleration<f64>) -> [f64; 18] {
    let base = [acceleration.angular.0, acceleration.linear.0].concat();
    std::array::from_fn(|i| if i < 6 { base[i] } else { acceleration.ddq[i - 6] })
}

fn forces((wrench, tau): &(Wrench<f64>, [f64; 12])) -> [f64; 18] {
    let base = [wrench.moment.0, wrench.force.0].concat();
    std::array::from_fn(|i| if i < 6 { base[i] } else { tau[i - 6] })
}

fn still() -> Acceleration<f64> {
    Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq: [0.0; 12] }
}

proptest! {
    #[test]
    fn forward_dynamics_is_the_inverse_of_inverse_dynamics(state in state(), tau in numbers::<12>(20.0)) {
        let acceleration = forward_dynamics(&tree(), &state, &tau, GRAVITY);
        let (wrench, torques) = inverse_dynamics(&tree(), &state, &acceleration, GRAVITY);
        let left = wrench.force.dot(wrench.force) + wrench.moment.dot(wrench.moment);
        prop_assert!(left.sqrt() < 1e-8, "wrench on the floating base: {wrench:?}");
        for (ours, given) in torques.iter().zip(tau) {
            prop_assert!((ours - given).abs() < 1e-9);
        }
    }

    #[test]
    fn force_is_mass_matrix_times_acceleration_plus_bias(state in state(), acceleration in acceleration()) {
        let matrix = mass_matrix(&tree(), &state.q);
        let bias = forces(&inverse_dynamics(&tree(), &state, &still(), GRAVITY));
        let whole = forces(&inverse_dynamics(&tree(), &state, &acceleration, GRAVITY));
        let acceleration = entries(&acceleration);
        for i in 0..18 {
            let sum: f64 = (0..18).map(|j| matrix[i][j] * acceleration[j]).sum();
            prop_assert!((whole[i] - bias[i] - sum).abs() < 1e-9, "row {i}");
        }
    }

    #[test]
    fn kinetic_energy_follows_from_the_mass_matrix(state in state()) {
        let rest = QuadrupedState { dq: [0.0; 12], linear_velocity: Vec3::zero(), angular_velocity: Vec3::zero(), ..state };
        let kinetic = energy(&go2(), &state) - energy(&go2(), &rest);
        let (matrix, v) = (mass_matrix(&tree(), &state.q), velocities(&state));
        let ours: f64 = (0..18).flat_map(|i| (0..18).map(move |j| (i, j))).map(|(i, j)| 0.5 * v[i] * matrix[i][j] * v[j]).sum();
        prop_assert!((ours - kinetic).abs() < 1e-6 * kinetic.max(1.0), "{ours} and {kinetic} J");
    }

    #[test]
    fn rate_of_energy_is_the_power_of_the_joints(state in state(), tau in numbers::<12>(20.0)) {
        const DT: f64 = 1e-4;
        let acceleration = forward_dynamics(&tree(), &state, &tau, GRAVITY);
        let (before, after) = (accelerated(&state, &acceleration, -DT), accelerated(&state, &acceleration, DT));
        let growth = (energy(&go2(), &after) - energy(&go2(), &before)) / (2.0 * DT);
        let power: f64 = tau.iter().zip(state.dq).map(|(tau, dq)| tau * dq).sum();
        prop_assert!((growth - power).abs() < 1e-3 * (1.0 + power.abs()), "{growth} and {power} W");
    }

    #[test]
    fn foot_position_and_jacobian_agree_with_forward_kinematics(state in state()) {
        let robot = go2();
        let foot = robot.shapes.foot_centre;
        let own = Frames::new(&tree(), &state.q);
        let poses = body_poses(&robot, Pose::IDENTITY, &state.q.map(|q| q as f32));
        for leg in 0..4 {
            let point = own.legs[leg].calf_point(Vec3::splat(foot));
            let reference = poses[3 + 3 * leg].transform(foot.as_vec3());
            prop_assert!((DVec3::from(point.0) - reference.as_dvec3()).length() < 1e-6);
            for (joint, column) in own.legs[leg].calf_jacobian(point).into_iter().enumerate() {
                let shifted = |by: f64| {
                    let mut q = state.q;
                    q[3 * leg + joint] += by;
                    DVec3::from(Frames::new(&tree(), &q).legs[leg].calf_point(Vec3::splat(foot)).0)
                };
                let derivative = (shifted(1e-6) - shifted(-1e-6)) / 2e-6;
                prop_assert!((DVec3::from(column.0) - derivative).length() < 1e-8);
            }
        }
    }

    #[test]
    fn inverse_dynamics_is_linear_in_the_inertia_of_a_body(state in state(), acceleration in acceleration(), factor in 0.1..3.0f64) {
        let torques = |scale: f64| {
            let mut robot = go2();
            robot.legs[1].bodies[2] = robot.legs[1].bodies[2].scaled(scale);
            forces(&inverse_dynamics(&KinematicTree::splat(&robot), &state, &acceleration, GRAVITY))
        };
        let (without, one, many) = (torques(0.0), torques(1.0), torques(factor));
        for i in 0..18 {
            prop_assert!((many[i] - without[i] - factor * (one[i] - without[i])).abs() < 1e-9);
        }
    }

    #[test]
    fn simd_inertia_gives_the_rotational_energy_of_the_body(com in numbers::<3>(0.1), turn in numbers::<3>(1.0), spin in numbers::<3>(1.0)) {
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::from(turn)));
        let inertia = rotation * DMat3::from_diagonal(DVec3::new(0.02, 0.03, 0.04)) * rotation.transpose();
        let body = RigidBody { mass: 2.0, com: DVec3::from(com), inertia };
        let (ours, omega) = (Inertia::<f64>::splat(&body), DVec3::from(spin));
        // Parallel-axis theorem.
        let about_com = omega.dot(inertia * omega) + body.mass * omega.cross(body.com).length_squared();
        prop_assert!((Vec3(spin).dot(ours.times(Vec3(spin))) - about_com).abs() < 1e-12);
    }
}
