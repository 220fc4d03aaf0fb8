//! Comparison of the joint effects with their laws, integrated here for one joint with ten times smaller steps.
//!
//! Only one calf moves. Its centre of mass is on its axis, so that neither gravity nor other joints act on it. It
//! follows a chirp under PD control. [`Law`] implements the equations that `twinstep effects` prints, not the code of
//! the engines.

use glam::DVec3;
use twinstep_effects::{Effect, EffectEntry, apply_effects};
use twinstep_model::{
    Backend, BaseMount, Command, InitialState, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, Simulator,
    go2,
};
use twinstep_sim::{BatchRollout, Engine, RapierBackend, SimConfig};

const CALF: usize = 2;
const PERIODS: usize = 200;
/// One actuator period [s].
const PERIOD: f64 = 0.005;
/// Physics steps per actuator period of the engines.
const STEPS: usize = 20;
/// Steps per actuator period of the integration here.
const FINE_STEPS: usize = 10 * STEPS;
const KP: f64 = 30.0;
const KD: f64 = 0.75;

/// Parameters of the effects of one joint. By default there is no effect.
#[derive(Clone, Copy, Default)]
struct Law {
    command_delay: f64,
    encoder_offset: f64,
    /// κ [N·m]. Here and below, 0 means no effect.
    saturation: f64,
    torque_delay: f64,
    no_load_speed: f64,
    lag: f64,
    /// Error of the torque constant: gain − 1.
    gain_error: f64,
    /// Amplitude [N·m], cycles per turn, phase [rad].
    ripple: [f64; 3],
    gap: f64,
    stiffness: f64,
    coulomb: f64,
    viscous: f64,
    /// Breakaway torque [N·m], Stribeck velocity [rad/s].
    stribeck: [f64; 2],
    load: f64,
    armature: f64,
    /// Stiffness [N·m/rad], rest position [rad].
    spring: [f64; 2],
}

/// Names and values of effects.
type Effects = &'static [(&'static str, &'static [f64])];
type Change = fn(&mut Law);

/// Effects, and the corresponding parameters of the law.
const CASES: [(Effects, Change); 19] = [
    (&[("command_delay", &[0.0123])], |law| law.command_delay = 0.0123),
    (&[("encoder_offset", &[0.04]), ("joint_spring", &[4.0, -1.0])], |law| {
        (law.encoder_offset, law.spring) = (0.04, [4.0, -1.0]);
    }),
    (&[("torque_saturation", &[2.0]), ("joint_spring", &[6.0, -1.5])], |law| {
        (law.saturation, law.spring) = (2.0, [6.0, -1.5]);
    }),
    (&[("torque_delay", &[0.0087])], |law| law.torque_delay = 0.0087),
    (&[("torque_speed_limit", &[6.0])], |law| law.no_load_speed = 6.0),
    (&[("drive_lag", &[0.01])], |law| law.lag = 0.01),
    (&[("torque_gain", &[0.7])], |law| law.gain_error = -0.3),
    (&[("torque_ripple", &[0.5, 14.0, 0.4])], |law| law.ripple = [0.5, 14.0, 0.4]),
    (&[("backlash", &[0.05]), ("viscous_friction", &[0.3])], |law| {
        (law.gap, law.stiffness, law.viscous) = (0.05, 2000.0, 0.3);
    }),
    (&[("joint_elasticity", &[60.0]), ("viscous_friction", &[0.1])], |law| (law.stiffness, law.viscous) = (60.0, 0.1)),
    (&[("backlash", &[0.03]), ("joint_elasticity", &[100.0]), ("viscous_friction", &[0.2])], |law| {
        (law.gap, law.stiffness, law.viscous) = (0.03, 100.0, 0.2);
    }),
    (&[("coulomb_friction", &[0.8])], |law| law.coulomb = 0.8),
    (&[("viscous_friction", &[0.3])], |law| law.viscous = 0.3),
    (&[("stribeck_friction", &[1.2, 0.4])], |law| law.stribeck = [1.2, 0.4]),
    (&[("coulomb_friction", &[0.2]), ("load_friction", &[0.2])], |law| (law.coulomb, law.load) = (0.2, 0.2)),
    (&[("armature", &[0.015])], |law| law.armature = 0.015),
    (&[("joint_spring", &[4.0, -1.0])], |law| law.spring = [4.0, -1.0]),
    // Order of the actuator chain up to the gear.
    (
        &[
            ("command_delay", &[0.007]),
            ("encoder_offset", &[-0.03]),
            ("torque_saturation", &[6.0]),
            ("torque_delay", &[0.004]),
            ("torque_speed_limit", &[15.0]),
            ("drive_lag", &[0.003]),
            ("torque_gain", &[0.8]),
            ("torque_ripple", &[0.3, 10.0, -1.0]),
        ],
        |law| {
            (law.command_delay, law.encoder_offset, law.saturation, law.torque_delay) = (0.007, -0.03, 6.0, 0.004);
            (law.no_load_speed, law.lag, law.gain_error, law.ripple) = (15.0, 0.003, -0.2, [0.3, 10.0, -1.0]);
        },
    ),
    // Order of the actuator chain from the gear on.
    (
        &[
            ("torque_gain", &[1.2]),
            ("joint_elasticity", &[150.0]),
            ("coulomb_friction", &[0.3]),
            ("viscous_friction", &[0.1]),
            ("stribeck_friction", &[0.4, 0.3]),
            ("load_friction", &[0.1]),
            ("armature", &[0.01]),
            ("joint_spring", &[2.0, -0.5]),
        ],
        |law| {
            (law.gain_error, law.stiffness, law.coulomb, law.viscous) = (0.2, 150.0, 0.3, 0.1);
            (law.stribeck, law.load, law.armature, law.spring) = ([0.4, 0.3], 0.1, 0.01, [2.0, -0.5]);
        },
    ),
];

/// Returns a robot of which only one calf moves, with its centre of mass on the axis and a wide range.
///
/// The other joints have such a high rotor inertia that they do not move.
fn lone_calf() -> RobotModel {
    let mut robot = go2();
    for (joint, model) in robot.joints.iter_mut().enumerate().filter(|(joint, _)| *joint != CALF) {
        model.armature = 1e4 + joint as f64;
    }
    robot.legs[0].bodies[2].com = DVec3::ZERO;
    robot.joints[CALF].range = [-6.0, 6.0];
    robot
}

fn start() -> f64 {
    go2().control.default_pose[CALF]
}

/// Returns the commanded position [rad] and velocity [rad/s]. Before t = 0 the joint is at rest.
fn chirp(t: f64) -> [f64; 2] {
    let t = t.max(0.0);
    let (phase, rate) = (std::f64::consts::TAU * (0.5 + 1.25 * t) * t, std::f64::consts::TAU * (0.5 + 2.5 * t));
    [start() + 0.4 * (1.0 - phase.cos()), 0.4 * rate * phase.sin()]
}

/// Integrates the law. Returns the encoder reading [rad] and the torque from motor current [N·m] after each period.
///
/// The torque is the mean over the preceding actuator period.
fn integrate(law: &Law) -> Vec<[f64; 2]> {
    let robot = lone_calf();
    let (limit, rotor_inertia) = (robot.joints[CALF].torque_limit, robot.joints[CALF].armature + law.armature);
    let elastic = law.stiffness > 0.0;
    let inertia = robot.legs[0].bodies[2].inertia.y_axis.y + if elastic { 0.0 } else { rotor_inertia };
    let h = PERIOD / FINE_STEPS as f64;
    let mut link = [start() - law.encoder_offset, 0.0];
    let (mut rotor, mut current, mut torques, mut rows) = (link, 0.0, Vec::new(), Vec::new());
    for period in 0..PERIODS {
        let start = period as f64 * PERIOD;
        let [target, speed] = chirp(start - law.command_delay);
        let mut tau = KP * (target - rotor[0] - law.encoder_offset) + KD * (speed - rotor[1]);
        if law.saturation > 0.0 {
            tau = law.saturation * (tau / law.saturation).tanh();
        }
        torques.push(tau.clamp(-limit, limit));
        let mut mean_current = 0.0;
        for step in 0..FINE_STEPS {
            let delayed = start + (step as f64 + 0.5) * h - law.torque_delay;
            let mut tau = if delayed < 0.0 { 0.0 } else { torques[(delayed / PERIOD) as usize] };
            if law.no_load_speed > 0.0 {
                let available = limit * (1.0 - rotor[1] * tau.signum() / law.no_load_speed).clamp(0.0, 1.0);
                tau = tau.clamp(-available, available);
            }
            current = if law.lag > 0.0 { current + h * (tau - current) / law.lag } else { tau };
            mean_current += current / FINE_STEPS as f64;
            let [amplitude, cycles, phase] = law.ripple;
            let motor = (1.0 + law.gain_error) * current + amplitude * (cycles * rotor[0] + phase).sin();
            let mut output = motor;
            if elastic {
                let twist = rotor[0] - link[0];
                output = law.stiffness * (twist - twist.clamp(-0.5 * law.gap, 0.5 * law.gap));
                rotor[1] += h * (motor - output) / rotor_inertia;
                rotor[0] += h * rotor[1];
            }
            let [breakaway, velocity] = law.stribeck;
            let stribeck = if breakaway > 0.0 { breakaway * (-(link[1] / velocity).powi(2)).exp() } else { 0.0 };
            let dry = law.coulomb + stribeck + law.load * motor.abs();
            let [spring, rest] = law.spring;
            let free = link[1] + h * (output - law.viscous * link[1] - spring * (link[0] - rest)) / inertia;
            link[1] = free.signum() * (free.abs() - h * dry / inertia).max(0.0);
            link[0] += h * link[1];
            if !elastic {
                rotor = link;
            }
        }
        rows.push([rotor[0] + law.encoder_offset, mean_current]);
    }
    rows
}

fn initial_state() -> InitialState {
    InitialState::at_rest(2.0, go2().control.default_pose_f32())
}

fn commands() -> Vec<Command> {
    let command = |period: usize| {
        let mut command = Command::hold(initial_state().q, KP as f32, KD as f32);
        let [q, dq] = chirp(period as f64 * PERIOD);
        (command.q[CALF], command.dq[CALF]) = (q as f32, dq as f32);
        command
    };
    (0..PERIODS).map(command).collect()
}

fn config(engine: Engine) -> SimConfig {
    let physics_hz = Some((STEPS as f64 / PERIOD) as u32);
    SimConfig { engine, base: BaseMount::Fixed, physics_hz, threads: 1, ..SimConfig::default() }
}

fn measured(states: &RobotStates, entry: usize) -> [f64; 2] {
    [states.measured.q[entry][CALF], states.measured.tau[entry][CALF]].map(f64::from)
}

fn in_rapier(robot: RobotModel) -> Vec<[f64; 2]> {
    let mut backend = RapierBackend::new(robot, config(Engine::Rapier), 1).unwrap();
    backend.reset(&[(0, initial_state())]).unwrap();
    let step = |command: &Command| {
        backend.step(&[*command], &[true], 1).unwrap();
        measured(backend.states(), 0)
    };
    commands().iter().map(step).collect()
}

/// Returns the RMS difference [rad]. Torque differences are divided by 50 N·m/rad.
fn rms(one: &[[f64; 2]], other: &[[f64; 2]]) -> f64 {
    let square =
        |(one, other): (&[f64; 2], &[f64; 2])| (one[0] - other[0]).powi(2) + (0.02 * (one[1] - other[1])).powi(2);
    (one.iter().zip(other).map(square).sum::<f64>() / one.len() as f64).sqrt()
}

#[test]
fn joint_effects_follow_their_laws_in_both_engines() {
    let robot = |entries: &[(&str, &[f64])]| {
        let entry = |(name, values): &(&str, &[f64])| {
            EffectEntry::new(Effect::named(name).unwrap(), "FL_calf".parse().unwrap(), values.to_vec()).unwrap()
        };
        apply_effects(&lone_calf(), &entries.iter().map(entry).collect::<Vec<_>>()).unwrap()
    };
    let commands = commands();
    let robots: Vec<_> = std::iter::once(lone_calf()).chain(CASES.iter().map(|(entries, _)| robot(entries))).collect();
    let jobs: Vec<_> = robots
        .iter()
        .map(|robot| RolloutRequest {
            robot,
            base: BaseMount::Fixed,
            start: initial_state(),
            history: &[],
            commands: &commands,
            derating: &[],
        })
        .collect();
    let rollouts = BatchRollout::new(&lone_calf(), &config(Engine::Batch)).unwrap().run(&jobs, Precision::Double);
    let in_batch = |index: usize| -> Vec<_> { (1..=PERIODS).map(|entry| measured(&rollouts[index], entry)).collect() };

    let ideal = integrate(&Law::default());
    assert!(rms(&in_batch(0), &ideal) < 2e-4, "{} rad", rms(&in_batch(0), &ideal));
    for (index, (entries, change)) in CASES.iter().enumerate() {
        let mut law = Law::default();
        change(&mut law);
        let expected = integrate(&law);
        let changed = rms(&expected, &ideal);
        let batch = rms(&in_batch(index + 1), &expected);
        let rapier = rms(&in_rapier(robots[index + 1].clone()), &expected);
        let names: Vec<_> = entries.iter().map(|(name, _)| *name).collect();
        println!("{:<50} change {changed:.4}, errors: batch {batch:.5}, rapier {rapier:.5}", names.join(" "));
        assert!(changed > 0.002, "{names:?}: the change is only {changed}");
        for error in [batch, rapier] {
            assert!(error < 0.01 * changed + 2e-4, "{names:?}: change {changed}, errors {batch} and {rapier} (rapier)");
        }
    }
}
