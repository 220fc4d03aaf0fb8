//! Comparison of the batch engine with rapier and with closed forms.

use rand::RngExt;
use twinstep_envs::{Randomisation, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_model::{
    AutoresetMode, Backend, BackendError, BaseMount, Command, GroundTruth, InitialState, Measured, NUM_JOINTS,
    PerJoint, ResetRequest, Restorable, RobotModel, Simulator, StepBatch, VecEnv, go2, stream,
};
use twinstep_sim::{BatchBackend, BatchBackend as TestedBackend, Engine, RapierBackend, SimConfig, SimdPrecision};
use twinstep_simd::InstructionSet;

const ENGINE: Engine = Engine::Batch;

#[path = "physics.rs"]
#[allow(clippy::duplicate_mod, reason = "the same tests for each engine")]
mod physics;

/// Actuator periods in a second.
const SECOND: usize = 200;

fn pose() -> PerJoint {
    go2().control.default_pose_f32()
}

fn at(physics_hz: u32, solver_iterations: u32, base: BaseMount) -> SimConfig {
    SimConfig {
        physics_hz: Some(physics_hz),
        solver_iterations: Some(solver_iterations),
        base,
        threads: 1,
        ..SimConfig::default()
    }
}

fn finest_rapier(base: BaseMount) -> RapierBackend {
    RapierBackend::new(go2(), at(4000, 4, base), 1).unwrap()
}

fn batch(config: SimConfig, robots: usize) -> BatchBackend {
    BatchBackend::new(go2(), config, robots).unwrap()
}

/// Returns the position targets of a simultaneous step of all joints [rad].
fn step_target(_: usize) -> PerJoint {
    std::array::from_fn(|j| pose()[j] + if j % 3 == 2 { -0.2 } else { 0.1 })
}

/// Returns the position targets of a trot at 2 Hz [rad].
fn trot_target(period: usize) -> PerJoint {
    let phase = std::f32::consts::TAU * 2.0 * period as f32 / SECOND as f32;
    std::array::from_fn(|j| {
        let leg = j / 3;
        let swing = phase.sin() * if leg == 0 || leg == 3 { 1.0 } else { -1.0 };
        pose()[j] + [0.0, 0.1 * phase.cos() * swing.signum(), -0.25 * swing.max(0.0)][j % 3]
    })
}

/// Returns the joint positions over one second of `target`, after 0.5 s in the default pose.
fn motion(backend: &mut impl Simulator, height: f32, target: fn(usize) -> PerJoint) -> Vec<PerJoint> {
    let initial_state = InitialState::at_rest(height, pose());
    backend.reset(&[(0, initial_state)]).unwrap();
    let robots = backend.num_robots();
    let mut follow = |target: PerJoint, periods: usize| {
        let commands = vec![Command::hold(target, 40.0, 1.0); robots];
        backend.step(&commands, &vec![true; robots], periods).unwrap();
        backend.measured().q[0]
    };
    follow(pose(), SECOND / 2);
    (0..SECOND).map(|period| follow(target(period), 1)).collect()
}

/// Returns the height of the trunk of a standing robot [m].
fn standing_height(backend: &mut impl Simulator) -> f32 {
    backend.reset(&[(0, InitialState::at_rest(0.335, pose()))]).unwrap();
    backend.step(&[Command::hold(pose(), 40.0, 1.0)], &[true], 3 * SECOND).unwrap();
    backend.states().truth.base_position[0][2]
}

fn rms_difference(one: &[PerJoint], other: &[PerJoint]) -> f32 {
    let pairs = one.iter().flatten().zip(other.iter().flatten());
    (pairs.map(|(one, other)| (one - other).powi(2)).sum::<f32>() / (one.len() * NUM_JOINTS) as f32).sqrt()
}

fn check(base: BaseMount, height: f32, target: fn(usize) -> PerJoint, limit: f32) {
    let reference = motion(&mut finest_rapier(base), height, target);
    let in_batch = motion(&mut batch(at(1000, 4, base), 1), height, target);
    let difference = rms_difference(&in_batch, &reference);
    println!("{difference}");
    assert!(difference < limit, "RMS difference to rapier: {difference} rad");
}

#[test]
fn fixed_base_motion_agrees_with_rapier() {
    check(BaseMount::Fixed, 1.0, step_target, 0.001);
    check(BaseMount::Fixed, 1.0, trot_target, 0.001);
}

#[test]
fn stance_step_agrees_with_rapier() {
    check(BaseMount::Floating, 0.335, step_target, 0.006);
}

#[test]
fn trot_agrees_with_rapier() {
    check(BaseMount::Floating, 0.335, trot_target, 0.02);
}

#[test]
fn penetration_of_soft_ground_agrees_with_rapier() {
    let mut robot = go2();
    robot.contact.time_constant = 0.05;
    let config = || at(1000, 4, BaseMount::Floating);
    let hard = standing_height(&mut batch(config(), 1));
    let [batch, rapier] = [
        hard - standing_height(&mut BatchBackend::new(robot.clone(), config(), 1).unwrap()),
        hard - standing_height(&mut RapierBackend::new(robot.clone(), config(), 1).unwrap()),
    ];
    println!("{batch} m, in rapier {rapier} m");
    assert!(batch > 0.005 && (rapier / batch - 1.0).abs() < 0.4, "{batch} m, in rapier {rapier} m");
}

#[test]
fn foot_forces_sum_to_the_weight() {
    let mut backend = batch(at(1000, 4, BaseMount::Floating), 1);
    backend.step(&[Command::hold(pose(), 40.0, 1.0)], &[true], 10 * SECOND).unwrap();
    let force: f32 = backend.states().truth.foot_force[0].iter().sum();
    let weight = go2().total_mass() as f32 * 9.81;
    assert!((force / weight - 1.0).abs() < 1e-3, "{force} N of {weight} N");
    assert!(!backend.states().truth.body_contact[0]);
}

/// Returns the Go2 with all masses multiplied by `factor`.
fn scaled(factor: f64) -> RobotModel {
    let mut robot = go2();
    let bodies = robot.legs.iter_mut().flat_map(|leg| &mut leg.bodies).chain([&mut robot.trunk]);
    bodies.for_each(|body| *body = body.scaled(factor));
    robot
}

#[test]
fn result_is_bitwise_independent_of_lane_batch_and_number_of_threads() {
    let run = |robots: usize, at_index: usize, threads: usize| {
        let config = SimConfig { threads, ..at(400, 4, BaseMount::Floating) };
        let mut backend = batch(config, robots);
        let initial_state = |robot: usize| InitialState::at_rest(0.3 + 0.01 * robot as f32, pose());
        let tested = InitialState { base_linear_velocity: [0.5, 0.2, 0.0], ..initial_state(3) };
        for robot in 0..robots {
            let (number, state) = if robot == at_index { (3, tested) } else { (robot, initial_state(robot)) };
            backend.reset_with_model(robot, &scaled(0.8 + 0.05 * number as f64), &state).unwrap();
        }
        for period in 0..SECOND {
            let commands = vec![Command::hold(trot_target(period), 30.0, 0.75); robots];
            backend.step(&commands, &vec![true; robots], 1).unwrap();
        }
        let states = backend.states();
        (states.measured.q[at_index], states.truth.base_position[at_index], states.measured.orientation[at_index])
    };
    let alone = run(1, 0, 1);
    for (robots, index, threads) in [(1, 0, 2), (8, 5, 1), (21, 20, 1), (21, 20, 2), (40, 9, 2)] {
        assert_eq!(run(robots, index, threads), alone, "robot {index} of {robots} on {threads} threads");
    }
}

/// Returns the joint positions after each actuator period of one second of trot, with this precision.
fn trot_in(precision: SimdPrecision) -> Vec<PerJoint> {
    motion(
        &mut BatchBackend::with_precision(go2(), at(1000, 4, BaseMount::Floating), 1, precision).unwrap(),
        0.335,
        trot_target,
    )
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let baseline = trot_in(SimdPrecision::Single(InstructionSet::PORTABLE));
    for instructions in InstructionSet::available() {
        assert_eq!(trot_in(SimdPrecision::Single(instructions)), baseline, "{instructions}");
    }
}

#[test]
fn single_precision_agrees_with_double() {
    let (single, double) = (trot_in(SimdPrecision::Single(InstructionSet::best())), trot_in(SimdPrecision::Double));
    let difference = rms_difference(&single, &double);
    assert!(difference > 0.0 && difference < 1e-4, "{difference} rad");
}

#[test]
fn joint_limits_hold_against_targets_beyond_them() {
    let robot = go2();
    let (lower, upper) = (robot.lower_limits(), robot.upper_limits());
    let mut random = stream(1, "targets", 0);
    let mut backend = batch(SimConfig { base: BaseMount::Fixed, threads: 1, ..SimConfig::default() }, 64);
    let mut beyond = 0.0f32;
    for _ in 0..200 {
        let commands: Vec<_> = (0..64)
            .map(|_| {
                let target = std::array::from_fn(|j| random.random_range(lower[j] - 0.5..upper[j] + 0.5));
                Command::hold(target, 40.0, 1.0)
            })
            .collect();
        backend.step(&commands, &[true; 64], 4).unwrap();
        for q in &backend.measured().q {
            beyond = (0..12).map(|j| (lower[j] - q[j]).max(q[j] - upper[j])).fold(beyond, f32::max);
        }
    }
    assert!(beyond > 0.001 && beyond < 0.05, "{beyond} rad beyond the limits");
}

#[test]
fn a_million_random_steps_of_random_robots_stay_finite() {
    const ROBOTS: usize = 1024;
    let mut random = stream(2, "robots", 0);
    let mut backend = batch(SimConfig::default(), ROBOTS);
    let randomise = Randomisation {
        mass_scale: [0.7, 1.3],
        payload_kg: [-1.0, 5.0],
        com_shift_m: [-0.05, 0.05],
        friction_scale: [0.2, 1.7],
        ..Randomisation::default()
    };
    for robot in 0..ROBOTS {
        let model = randomise.sample(&go2(), &mut random).unwrap();
        backend.reset_with_model(robot, &model, &InitialState::at_rest(0.4, pose())).unwrap();
    }
    for _ in 0..1_000_000 / ROBOTS {
        let commands: Vec<_> =
            (0..ROBOTS).map(|_| Command::hold(pose().map(|q| q + random.random_range(-0.8..0.8)), 40.0, 1.0)).collect();
        backend.step(&commands, &[true; ROBOTS], 4).unwrap();
    }
    let states = backend.states();
    for robot in 0..ROBOTS {
        let [.., z] = states.truth.base_position[robot];
        assert!((-0.05..2.0).contains(&z), "robot {robot} is at a height of {z} m");
        assert!(
            states.measured.dq[robot].iter().all(|dq| dq.abs() < 100.0),
            "robot {robot}: {:?}",
            states.measured.dq[robot]
        );
    }
}

/// Backend in which a torque of one robot becomes NaN in one step.
struct FailingBackend {
    inner: BatchBackend,
    step: usize,
}

const FAILING_STEP: usize = 3;
const FAILING_ROBOT: usize = 5;

impl Backend for FailingBackend {
    fn robot(&self) -> &RobotModel {
        Backend::robot(&self.inner)
    }

    fn measured(&self) -> &Measured {
        self.inner.measured()
    }

    fn ground_truth(&self) -> Option<&GroundTruth> {
        self.inner.ground_truth()
    }

    fn reset(&mut self, initial_states: &[(usize, InitialState)]) -> Result<(), BackendError> {
        self.inner.reset(initial_states)
    }

    fn step(&mut self, commands: &[Command], active: &[bool], periods: usize) -> Result<(), BackendError> {
        let mut commands = commands.to_vec();
        if self.step == FAILING_STEP {
            commands[FAILING_ROBOT].tau_ff[0] = f32::NAN;
        }
        self.step += 1;
        self.inner.step(&commands, active, periods)
    }
}

#[test]
fn diverged_robot_is_truncated_with_its_last_observation_and_everyone_else_gets_their_step() {
    const ROBOTS: usize = 4096;
    for autoreset in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
        let run = |fails: bool| {
            let inner = batch(SimConfig::default(), ROBOTS);
            let backend = FailingBackend { inner, step: if fails { 0 } else { usize::MAX / 2 } };
            let walk = Walk::new(WalkConfig::default(), &go2(), true).unwrap();
            let (randomise, robot_sampler) = (Randomisation::default(), None);
            let settings = TaskEnvConfig { randomise, robot_sampler, autoreset, max_episode_steps: None, seed: 1 };
            let mut env = TaskEnv::new(backend, walk, settings).unwrap();
            env.reset(&ResetRequest::seeded(7, ROBOTS)).unwrap();
            let mut steps: Vec<StepBatch> = Vec::new();
            for step in 0..FAILING_STEP + 3 {
                if autoreset == AutoresetMode::Disabled && steps.last().is_some_and(|last| last.done(FAILING_ROBOT)) {
                    let mask = (0..ROBOTS).map(|robot| robot == FAILING_ROBOT).collect();
                    env.reset(&ResetRequest::masked(mask)).unwrap();
                }
                steps.push(env.step(&vec![0.1 * (step as f32).sin(); 12 * ROBOTS]).unwrap().clone());
            }
            steps
        };
        let (expected, steps) = (run(false), run(true));
        let row = |batch: &StepBatch, robot: usize| batch.obs[45 * robot..45 * (robot + 1)].to_vec();
        for (step, (expected, batch)) in expected.iter().zip(&steps).enumerate() {
            for robot in (0..ROBOTS).filter(|robot| *robot != FAILING_ROBOT) {
                assert_eq!(row(batch, robot), row(expected, robot), "{autoreset:?}, step {step}, robot {robot}");
                assert_eq!(batch.reward[robot], expected.reward[robot]);
            }
            assert!(batch.obs.iter().all(|entry| entry.is_finite()));
            assert_eq!(batch.truncated[FAILING_ROBOT], step == FAILING_STEP, "{autoreset:?}, step {step}");
        }
        let (before, failed) = (&steps[FAILING_STEP - 1], &steps[FAILING_STEP]);
        let [ended] = &failed.ended[..] else { panic!("{:?}", failed.ended) };
        assert!(ended.diverged && ended.env == FAILING_ROBOT && !failed.terminated[FAILING_ROBOT]);
        let last =
            if autoreset == AutoresetMode::SameStep { ended.final_obs.clone() } else { row(failed, FAILING_ROBOT) };
        assert_eq!(last, row(before, FAILING_ROBOT), "{autoreset:?}: the last finite observation");
        let after = steps.last().unwrap();
        assert_ne!(row(after, FAILING_ROBOT), row(before, FAILING_ROBOT), "{autoreset:?}: a new episode runs");
    }
}

#[test]
fn diverged_robot_is_named_and_the_others_are_not_affected() {
    let run = |broken: bool| {
        let mut backend = batch(at(400, 4, BaseMount::Floating), 8);
        let mut commands = vec![Command::hold(pose(), 30.0, 0.75); 8];
        if broken {
            commands[2].tau_ff[4] = f32::NAN;
        }
        let results: Vec<_> = (0..20).map(|_| backend.step(&commands, &[true; 8], 1)).collect();
        (backend.states().clone(), results.into_iter().find_map(Result::err).map(|error| error.to_string()))
    };
    let ((expected, no_error), (states, error)) = (run(false), run(true));
    assert_eq!(no_error, None);
    assert!(error.unwrap().starts_with("the simulation of robot 2 diverged"));
    for robot in (0..8).filter(|robot| *robot != 2) {
        assert_eq!(states.measured.q[robot], expected.measured.q[robot], "robot {robot}");
    }
}

#[test]
fn restored_snapshot_continues_bitwise_identically() {
    let mut backend = batch(at(400, 4, BaseMount::Floating), 3);
    let trot = |backend: &mut BatchBackend| {
        for period in 0..50 {
            backend.step(&[Command::hold(trot_target(period), 30.0, 0.75); 3], &[true; 3], 1).unwrap();
        }
        (backend.measured().q[1], backend.states().truth.base_position[1])
    };
    trot(&mut backend);
    let snapshot = backend.snapshot(1);
    let first = trot(&mut backend);
    backend.restore(1, &snapshot);
    assert_eq!(trot(&mut backend), first);
}

#[test]
fn inactive_robots_do_not_change() {
    let mut backend = batch(at(400, 4, BaseMount::Floating), 3);
    let before = backend.states().clone();
    backend.step(&[Command::hold(pose(), 30.0, 0.75); 3], &[true, false, true], 10).unwrap();
    assert_eq!(backend.measured().q[1], before.measured.q[1]);
    assert_ne!(backend.measured().q[2], before.measured.q[2]);
    assert_eq!(backend.states().truth.base_position[1], before.truth.base_position[1]);
}
