//! Comparison of effects of bodies and ground with closed forms.

use std::f64::consts::TAU;

use glam::{DVec3, Vec3};
use twinstep_effects::{Effect, EffectEntry, apply_effects};
use twinstep_model::{
    Backend, BaseMount, Command, InitialState, Joint, PerJoint, Pose, RigidBody, RobotModel, RobotStates, Simulator,
    body_poses, frames, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};

const GRAVITY: f64 = 9.81;
const CALF: usize = 2;
/// Log-Cholesky parameters of a body without products of inertia.
const ALPHA: f64 = -0.55;
const D1: f64 = -3.2;
const D2: f64 = -3.0;
const D3: f64 = -2.4;

pub fn with(robot: &RobotModel, effects: &[(&str, &str, &[f64])]) -> RobotModel {
    let entry = |(name, scope, values): &(&str, &str, &[f64])| {
        EffectEntry::new(Effect::named(name).unwrap(), scope.parse().unwrap(), values.to_vec()).unwrap()
    };
    apply_effects(robot, &effects.iter().map(entry).collect::<Vec<_>>()).unwrap()
}

pub fn config(base: BaseMount, physics_hz: u32) -> SimConfig {
    SimConfig { base, physics_hz: Some(physics_hz), threads: 1, ..SimConfig::default() }
}

pub fn batch(robot: &RobotModel, config: SimConfig, placement: InitialState) -> BatchBackend {
    let mut backend = BatchBackend::new(robot.clone(), config, 1).unwrap();
    backend.reset(&[(0, placement)]).unwrap();
    backend
}

pub fn rapier(robot: &RobotModel, config: SimConfig, placement: InitialState) -> RapierBackend {
    let config = SimConfig { engine: Engine::Rapier, ..config };
    let mut backend = RapierBackend::new(robot.clone(), config, 1).unwrap();
    backend.reset(&[(0, placement)]).unwrap();
    backend
}

pub fn run(backend: &mut impl Simulator, command: &Command, seconds: f64) {
    backend.step(&[*command], &[true], (seconds * 200.0).round() as usize).unwrap();
}

pub fn pose() -> PerJoint {
    go2().control.default_pose_f32()
}

/// Returns the poses of the bodies' frames in the world, trunk first.
fn frames_of(states: &RobotStates) -> Vec<Pose> {
    let trunk = Pose {
        position: Vec3::from(states.truth.base_position[0]),
        rotation: frames::world_from_base(states.measured.orientation[0]),
    };
    body_poses(&go2(), trunk, &states.measured.q[0]).to_vec()
}

/// Returns the body index, mass [kg] and position in the body's frame [m] of every point mass.
///
/// Body `body` consists of the masses that `change` returns, every other body of its nominal mass.
fn masses(body: usize, change: impl Fn(&RigidBody) -> Vec<(f64, DVec3)>) -> Vec<(usize, f64, DVec3)> {
    let robot = go2();
    let bodies = std::iter::once(&robot.trunk).chain(robot.legs.iter().flat_map(|leg| &leg.bodies));
    let masses = bodies.enumerate().flat_map(|(index, own)| {
        let parts = if index == body { change(own) } else { vec![(own.mass, own.com)] };
        parts.into_iter().map(move |(mass, position)| (index, mass, position))
    });
    masses.collect()
}

/// An effect of a body with its values, and the point masses of the changed body.
type BodyCase<'a> = ((&'a str, &'a [f64]), fn(&RigidBody) -> Vec<(f64, DVec3)>);

const LINK_CASES: [BodyCase; 3] = [
    (("payload", &[0.4, 0.05, 0.03, -0.1]), |own| vec![(own.mass, own.com), (0.4, DVec3::new(0.05, 0.03, -0.1))]),
    (("com_shift", &[0.04, -0.02, -0.06]), |own| vec![(own.mass, own.com + DVec3::new(0.04, -0.02, -0.06))]),
    (("inertia", &[ALPHA, D1, D2, D3, 0.0, 0.0, 0.0, 0.03, 0.02, -0.12]), |_| {
        vec![((2.0 * ALPHA).exp(), DVec3::new(0.03, 0.02, -0.12))]
    }),
];

#[test]
fn holding_torques_balance_the_weight_of_the_links() {
    for ((name, values), change) in LINK_CASES {
        let robot = with(&go2(), &[(name, "FL_calf", values)]);
        let mut backend = batch(&robot, config(BaseMount::Fixed, 1000), InitialState::at_rest(1.0, pose()));
        run(&mut backend, &Command::hold(pose(), 60.0, 2.0), 3.0);
        let (states, frames) = (backend.states(), frames_of(backend.states()));
        for joint in 0..3 {
            let axis = frames[1 + joint].rotation * RobotModel::axis(Joint::ALL[joint]).as_vec3();
            let expected: f64 = masses(1 + CALF, change)
                .iter()
                .filter(|(body, ..)| (1 + joint..=3).contains(body))
                .map(|(body, mass, position)| {
                    let lever = frames[*body].transform(position.as_vec3()) - frames[1 + joint].position;
                    mass * GRAVITY * f64::from(axis.dot(lever.cross(Vec3::Z)))
                })
                .sum();
            let tau = f64::from(states.measured.tau[0][joint]);
            assert!((tau - expected).abs() < 2e-3, "`{name}`, joint {joint}: {tau} N·m, expected {expected} N·m");
        }
    }
}

/// Returns `robot` with such a high rotor inertia at every joint except [`CALF`] that only this joint moves.
fn lone_calf(robot: &RobotModel) -> RobotModel {
    let mut robot = robot.clone();
    for (_, model) in robot.joints.iter_mut().enumerate().filter(|(joint, _)| *joint != CALF) {
        model.armature = 1e4;
    }
    robot.joints[CALF].range = [-6.0, 6.0];
    robot
}

#[test]
fn unactuated_calf_swings_with_the_period_of_its_pendulum() {
    // Moments of inertia about the calf's axis, y, without those of the point masses.
    let own = go2().legs[0].bodies[2].inertia.y_axis.y;
    let moments = [own, own, (2.0 * ALPHA).exp() * ((2.0 * D1).exp() + (2.0 * D3).exp())];
    for (((name, values), change), moment) in LINK_CASES.into_iter().zip(moments) {
        let robot = lone_calf(&with(&go2(), &[(name, "FL_calf", values)]));
        let (mut inertia, mut lever) = (moment + robot.joints[CALF].armature, DVec3::ZERO);
        for (_, mass, position) in masses(1 + CALF, change).iter().filter(|(body, ..)| *body == 1 + CALF) {
            inertia += mass * (position.x.powi(2) + position.z.powi(2));
            lever += *mass * *position;
        }
        let expected = TAU * (inertia / (GRAVITY * lever.x.hypot(lever.z))).sqrt();

        let rest = lever.x.atan2(-lever.z);
        let mut initial_state = InitialState::at_rest(2.0, [0.0; 12]);
        initial_state.q[CALF] = rest as f32 + 0.1;
        let mut backend = batch(&robot, config(BaseMount::Fixed, 1000), initial_state);
        let mut crossings = Vec::new();
        let mut before = 1.0;
        for period in 1..=1000 {
            run(&mut backend, &Command::hold([0.0; 12], 0.0, 0.0), 0.005);
            let now = f64::from(backend.measured().q[0][CALF]) - rest;
            if before > 0.0 && now <= 0.0 {
                crossings.push(0.005 * (f64::from(period) - now / (now - before)));
            }
            before = now;
        }
        let swings = (crossings.len() - 1) as f64;
        let measured = (crossings[crossings.len() - 1] - crossings[0]) / swings;
        assert!((measured / expected - 1.0).abs() < 2e-3, "`{name}`: {measured} s, closed form {expected} s");
    }
}

#[test]
fn centre_of_pressure_is_below_the_centre_of_mass() {
    let cases: [BodyCase; 3] = [
        (("payload", &[3.0, 0.12, 0.05, 0.1]), |own| vec![(own.mass, own.com), (3.0, DVec3::new(0.12, 0.05, 0.1))]),
        (("com_shift", &[-0.05, 0.03, 0.02]), |own| vec![(own.mass, own.com + DVec3::new(-0.05, 0.03, 0.02))]),
        (("inertia", &[1.1, -1.9, -2.3, -2.8, 0.0, 0.0, 0.0, 0.04, -0.02, 0.01]), |_| {
            vec![(2.2f64.exp(), DVec3::new(0.04, -0.02, 0.01))]
        }),
    ];
    for ((name, values), change) in cases {
        let robot = with(&go2(), &[(name, "base", values)]);
        let mut backend = batch(&robot, config(BaseMount::Floating, 1000), InitialState::at_rest(0.33, pose()));
        run(&mut backend, &Command::hold(pose(), 100.0, 3.0), 4.0);
        let (states, frames) = (backend.states(), frames_of(backend.states()));
        let (mut weight, mut moment) = (0.0, DVec3::ZERO);
        for (body, mass, position) in masses(0, change) {
            weight += GRAVITY * mass;
            moment += GRAVITY * mass * frames[body].transform(position.as_vec3()).as_dvec3();
        }
        let (mut total_force, mut foot_moment) = (0.0, DVec3::ZERO);
        for (leg, force) in states.truth.foot_force[0].into_iter().enumerate() {
            total_force += f64::from(force);
            let foot = frames[3 + 3 * leg].transform(robot.shapes.foot_centre.as_vec3());
            foot_moment += f64::from(force) * foot.as_dvec3();
        }
        assert!((total_force / weight - 1.0).abs() < 2e-3, "`{name}`: {total_force} N on the feet, weight {weight} N");
        let error = (foot_moment / total_force - moment / weight).truncate();
        assert!(error.length() < 1e-3, "`{name}`: error of the centre of pressure: {error} m");
    }
}

#[test]
fn sliding_robot_decelerates_by_friction_times_gravity() {
    fn deceleration(mut backend: impl Simulator, hold: &Command) -> f64 {
        run(&mut backend, hold, 0.1);
        let before = backend.states().truth.base_linear_velocity[0][0];
        run(&mut backend, hold, 0.2);
        f64::from(before - backend.states().truth.base_linear_velocity[0][0]) / 0.2
    }
    // A stiff crouch, so that the robot does not tip over.
    let crouch = Joint::map_kinds(0.0, 1.3, -2.6);
    let ground = InitialState::standing_on(&twinstep_model::Ground::FLAT, &go2(), crouch, 0.0);
    let initial_state = InitialState { base_linear_velocity: [2.0, 0.0, 0.0], ..ground };
    let hold = Command::hold(crouch, 200.0, 5.0);
    for coefficient in [0.1, 0.3] {
        let robot = with(&go2(), &[("ground_friction", "ground", &[coefficient])]);
        let config = config(BaseMount::Floating, 1000);
        let engines = [
            deceleration(batch(&robot, config, initial_state), &hold),
            deceleration(rapier(&robot, config, initial_state), &hold),
        ];
        for measured in engines {
            let expected = coefficient * GRAVITY;
            assert!((measured / expected - 1.0).abs() < 0.03, "{measured} m/s², closed form {expected}: {engines:?}");
        }
    }
}

/// Integrates MuJoCo's soft contact with time constant T [s] and returns the height [m] after each 5 ms.
///
/// `a = d (−b v − k d r) + (1 − d) free`, with the unconstrained acceleration `free` [m/s²] and the initial height 0.
/// The impedance d grows with the depth, from 0.9 to 0.95 over 1 mm.
fn penetration(time_constant: f64, free: f64, periods: usize) -> Vec<f64> {
    let (h, [mut r, mut v]) = (5e-6, [0.0, 0.0]);
    let (b, k) = (2.0 / (0.95 * time_constant), (0.95 * time_constant).powi(-2));
    let mut after_5_ms = || {
        for _ in 0..1000 {
            let d = 0.9 + 0.05 * (-r / 0.001f64).clamp(0.0, 1.0);
            v += h * (d * (-b * v - k * d * r) + (1.0 - d) * free);
            r += h * v;
        }
        r
    };
    (0..periods).map(|_| after_5_ms()).collect()
}

/// A constant torque presses a foot onto ground without friction. Only its joint can move.
#[test]
fn pressed_foot_penetrates_with_the_time_constant_of_the_ground() {
    for time_constant in [0.05, 0.1] {
        let mut robot = lone_calf(&with(&go2(), &[("ground_stiffness", "ground", &[time_constant])]));
        robot.contact.friction = 0.0;
        let height = |states: &RobotStates| {
            let foot = frames_of(states)[3].transform(robot.shapes.foot_centre.as_vec3());
            f64::from(foot.z) - robot.shapes.foot_radius
        };
        // The foot height is measured above the ground first. The other legs are folded.
        let mut q = pose();
        for leg in 1..4 {
            (q[3 * leg + 1], q[3 * leg + 2]) = (1.5, -2.7);
        }
        let above_ground = batch(&robot, config(BaseMount::Fixed, 2000), InitialState::at_rest(1.0, q));
        let touching = 1.0 - height(above_ground.states());
        let mut backend = batch(&robot, config(BaseMount::Fixed, 2000), InitialState::at_rest(touching as f32, q));

        let body = &robot.legs[0].bodies[2];
        let inertia =
            body.inertia.y_axis.y + body.mass * (body.com.x.powi(2) + body.com.z.powi(2)) + robot.joints[CALF].armature;
        // Acceleration that causes a penetration of 4 mm.
        let free_acceleration = -0.004 / (0.05 * time_constant * time_constant);
        let pressing_command = |states: &RobotStates| {
            let rotation = frames_of(states)[3].rotation;
            // Derivative of the foot height with respect to the joint angle, about y.
            let derivative = -f64::from((rotation * robot.shapes.foot_centre.as_vec3()).x);
            let weight = body.mass * GRAVITY * f64::from((rotation * body.com.as_vec3()).x);
            let mut command = Command::hold(q, 0.0, 0.0);
            command.tau_ff[CALF] = (free_acceleration / derivative * inertia - weight) as f32;
            command
        };
        let expected = penetration(time_constant, free_acceleration, (10.0 * time_constant / 0.005) as usize);
        for (period, expected) in expected.iter().enumerate() {
            let command = pressing_command(backend.states());
            run(&mut backend, &command, 0.005);
            let measured = height(backend.states());
            assert!((measured - expected).abs() < 4e-5, "T = {time_constant} s, {period}: {measured} m, {expected} m");
        }
        // At full impedance, a spring of 1/T² balances a twentieth of the acceleration.
        assert!((expected[expected.len() - 1] / -0.004 - 1.0).abs() < 0.01, "{expected:?}");
    }
}
