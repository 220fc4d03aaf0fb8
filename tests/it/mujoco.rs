//! The engine `mujoco`: motions next to the batch engine, and failures of its process. Skipped without Python.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use expect_test::{Expect, expect};
use tempfile::TempDir;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, Target, apply_effects};
use twinstep_envs::{Randomisation, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_logs::Log;
use twinstep_model::{
    AutoresetMode, Backend, BackendError, BaseMount, Command, EnvError, InitialState, NUM_JOINTS, PerJoint,
    ResetRequest, RobotModel, Simulator, VecEnv, go2,
};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_sim::{
    BackendBuildError, BatchBackend, Engine, MujocoBackend, MujocoPlant, RoughTerrain, SimConfig, StepTerrain, Terrain,
};
use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, python, root, run};

use crate::effects::{entry, rms, rows, start};

/// Python interpreter with the package of this repository: a script, whose folder is deleted with it.
struct Interpreter(TempDir);

impl Interpreter {
    /// Returns the interpreter of the tests. Returns `None` with a message on stderr if there is no Python.
    fn of_tests() -> Option<Self> {
        Self::in_folder(Path::new("."))
    }

    /// Returns the interpreter of the tests with a current folder.
    fn in_folder(folder: &Path) -> Option<Self> {
        let python = python(&crate::python::target()).unwrap()?;
        let (folder, source, python) = (folder.display(), root().join("clients/python/src"), python.display());
        Some(Self::script(&format!("cd {folder} && PYTHONPATH={} exec {python} \"$@\"", source.display())))
    }

    /// Returns a shell script in place of an interpreter.
    fn script(commands: &str) -> Self {
        let this = Self(tempfile::tempdir().unwrap());
        std::fs::write(this.path(), format!("#!/bin/sh\n{commands}\n")).unwrap();
        std::fs::set_permissions(this.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
        this
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("python")
    }

    fn backend(&self, robot: RobotModel, config: SimConfig, robots: usize) -> MujocoBackend {
        MujocoBackend::with_python(robot, config, robots, &self.path()).unwrap()
    }
}

fn config() -> SimConfig {
    SimConfig { engine: Engine::Mujoco, threads: 1, ..SimConfig::default() }
}

fn hold() -> Command {
    Command::hold(go2().control.default_pose_f32(), 40.0, 1.0)
}

/// Returns the joint targets of a trot at 2 Hz, in which diagonal legs alternate.
fn trot(step: usize) -> PerJoint {
    let phase = std::f32::consts::TAU * 2.0 * step as f32 / 50.0;
    let pose = go2().control.default_pose_f32();
    std::array::from_fn(|joint| {
        let swing = phase.sin() * if [0, 3].contains(&(joint / 3)) { 1.0 } else { -1.0 };
        pose[joint] + [0.0, 0.1 * phase.cos() * swing.signum(), -0.25 * swing.max(0.0)][joint % 3]
    })
}

#[test]
fn robot_stands_for_5_s_of_zero_actions() {
    let Some(python) = Interpreter::of_tests() else { return };
    let walk = Walk::new(WalkConfig::default(), &go2(), true).unwrap();
    let randomise = Randomisation { friction_scale: [0.8, 1.2], payload_kg: [0.0, 2.0], ..Randomisation::default() };
    let settings = TaskEnvConfig { randomise, ..TaskEnvConfig::new(AutoresetMode::NextStep, 1) };
    let mut env = TaskEnv::new(python.backend(go2(), config(), 3), walk, settings).unwrap();
    env.reset(&ResetRequest::seeded(7, 3)).unwrap();
    for step in 0..250 {
        let batch = env.step(&[0.0; 3 * NUM_JOINTS]).unwrap();
        assert!(!(0..3).any(|robot| batch.done(robot)), "step {step}");
    }
    let states = env.backend().states();
    for robot in 0..3 {
        assert!(states.truth.base_position[robot][2] > 0.25 && !states.truth.body_contact[robot]);
        assert!(states.truth.foot_force[robot].iter().all(|force| *force > 5.0), "{:?}", states.truth.foot_force);
        assert!((states.measured.stamp[robot] - 5.0).abs() < 1e-9);
    }
}

/// Returns the mean forward velocity [m/s] and the number of falls of robots that walk over steps of 5 cm.
fn walk_over_steps<B: Backend>(backend: B) -> (f32, usize) {
    let (policy, _) = Policy::read(root().join("data/policies/walk_robust.safetensors")).unwrap();
    let (walk, robots) = (Walk::new(WalkConfig::default(), &go2(), true).unwrap(), backend.num_robots());
    let settings = TaskEnvConfig::new(AutoresetMode::Disabled, 1);
    let mut env = TaskEnv::new(backend, walk, settings).unwrap();
    env.set_velocity_commands(&vec![[0.5, 0.0, 0.0]; robots]).unwrap();
    let mut obs = env.reset(&ResetRequest::seeded(3, robots)).unwrap().to_vec();
    let (mut runner, mut actions) = (PolicyRunner::new(&policy), vec![0.0; robots * NUM_JOINTS]);
    let (mut has_fallen, mut velocities) = (vec![false; robots], Vec::new());
    for _ in 0..300 {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions).unwrap();
        obs.copy_from_slice(&batch.obs);
        has_fallen.iter_mut().zip(&batch.terminated).for_each(|(has_fallen, ended)| *has_fallen |= ended);
        if has_fallen.contains(&true) {
            env.reset(&ResetRequest { seeds: None, mask: Some(has_fallen.clone()) }).unwrap();
        }
        let truth = env.backend().ground_truth().unwrap();
        velocities
            .extend((0..robots).filter(|robot| !has_fallen[*robot]).map(|robot| truth.base_linear_velocity[robot][0]));
    }
    let falls = has_fallen.iter().filter(|has_fallen| **has_fallen).count();
    (velocities.iter().sum::<f32>() / velocities.len() as f32, falls)
}

/// A step is as high as it is: before the batch engine touched the nearest point of a face, half of the robots fell at 5 cm.
#[test]
fn policy_walks_over_steps_as_in_the_batch_engine() {
    let Some(python) = Interpreter::of_tests() else { return };
    let terrain = Terrain::Steps(StepTerrain { height_m: 0.05, tread_m: 0.3, size_m: 12.0, seed: 1 });
    let (mujoco, batch) =
        (SimConfig { terrain, ..config() }, SimConfig { terrain, threads: 1, ..SimConfig::default() });
    let (expected, expected_falls) = walk_over_steps(python.backend(go2(), mujoco, 16));
    let (velocity, falls) = walk_over_steps(BatchBackend::new(go2(), batch, 16).unwrap());
    assert!(expected > 0.4 && (velocity - expected).abs() < 0.06, "{velocity} m/s instead of {expected}");
    assert!(falls.abs_diff(expected_falls) <= 3, "{falls} falls instead of {expected_falls}");
}

#[test]
fn pushed_robot_is_faster_by_the_push() {
    let Some(python) = Interpreter::of_tests() else { return };
    let mut backend = python.backend(go2(), config(), 2);
    backend.push(1, [0.5, -0.25, 0.0]).unwrap();
    assert_eq!(backend.states().truth.base_linear_velocity, [[0.0; 3], [0.5, -0.25, 0.0]]);
    backend.step(&[hold(); 2], &[true; 2], 1).unwrap();
    let [still, pushed] = [0, 1].map(|robot| backend.states().truth.base_position[robot][0]);
    assert!((0.001..0.003).contains(&(pushed - still)), "0.5 m/s for 5 ms, slowed by the feet: {still} {pushed}");
    let error = backend.push(2, [0.5, 0.0, 0.0]).unwrap_err();
    assert_eq!(error.to_string(), "robot 2 does not exist; the number of robots is 2");
}

#[test]
fn first_second_of_a_trot_agrees_with_the_batch_engine() {
    let Some(python) = Interpreter::of_tests() else { return };
    let run = |backend: &mut dyn Backend| -> Vec<PerJoint> {
        let ground = backend.ground();
        let placed = InitialState::standing_on(&ground, &go2(), go2().control.default_pose_f32(), 0.0);
        backend.reset(&[(0, placed)]).unwrap();
        let step = |step| {
            backend.step(&[Command { q: trot(step), ..hold() }], &[true], 4).unwrap();
            backend.measured().q[0]
        };
        (0..50).map(step).collect()
    };
    for (terrain, bound) in [(Terrain::Flat, 0.005), (Terrain::SlopeRad(0.1), 0.005)] {
        let config = SimConfig { terrain, ..config() };
        let ours = run(&mut BatchBackend::new(go2(), SimConfig { engine: Engine::Batch, ..config }, 1).unwrap());
        let theirs = run(&mut python.backend(go2(), config, 1));
        let (difference, travel) = (rms(&ours, &theirs), rms(&theirs, &vec![go2().control.default_pose_f32(); 50]));
        println!("{terrain:?}: {difference:.5} rad RMS, motion {travel:.5} rad");
        assert!(difference < bound && travel > 0.05, "{difference} rad");
    }
}

#[test]
fn robots_settle_on_rough_ground_as_in_the_batch_engine() {
    let Some(python) = Interpreter::of_tests() else { return };
    let terrain = Terrain::Rough(RoughTerrain { height_m: 0.05, cell_m: 0.5, size_m: 10.0, seed: 1 });
    let config = SimConfig { terrain, ..config() };
    // Between vertices, left and right of the diagonals, and on the plane around the field.
    let places = [[0.1, 0.2], [-1.3, 2.9], [3.4, -2.2], [-2.6, -3.7], [1.9, 1.1], [8.0, 0.0]];
    let settled = |backend: &mut dyn Simulator| -> Vec<[f32; 3]> {
        let dropped = |[x, y]: [f32; 2]| {
            let state = InitialState::at_rest(0.38, go2().control.default_pose_f32());
            InitialState { base_position: [x, y, 0.38], ..state }
        };
        let states: Vec<_> = places.into_iter().map(dropped).enumerate().collect();
        backend.reset(&states).unwrap();
        for _ in 0..50 {
            backend.step(&[hold(); 6], &[true; 6], 4).unwrap();
        }
        backend.states().truth.base_position.clone()
    };
    let ours = settled(&mut BatchBackend::new(go2(), SimConfig { engine: Engine::Batch, ..config }, 6).unwrap());
    let theirs = settled(&mut python.backend(go2(), config, 6));
    let heights: Vec<_> = theirs.iter().map(|position| position[2]).collect();
    println!("{ours:.4?}\n{theirs:.4?}");
    let [low, high] = heights.iter().fold([f32::MAX, f32::MIN], |[low, high], z| [low.min(*z), high.max(*z)]);
    assert!(high - low > 0.015, "the ground is uneven: {heights:?}");
    let mut differences: Vec<_> = ours.iter().zip(&theirs).map(|(ours, theirs)| (ours[2] - theirs[2]).abs()).collect();
    differences.sort_by(f32::total_cmp);
    // A foot may slide off an edge in one engine only.
    assert!(differences[4] < 0.002 && differences[5] < 0.01, "{differences:?} m");
}

#[test]
fn every_effect_acts_as_in_the_batch_engine_or_is_rejected_by_name() {
    let Some(python) = Interpreter::of_tests() else { return };
    // These depend on a logged voltage, temperature or torque and do not change the motion here.
    let log_effects = ["supply_sag", "thermal_derating", "torque_sensor_delay"];
    let mut rejected = Vec::new();
    for base in [BaseMount::Fixed, BaseMount::Floating] {
        // In the air the error of MuJoCo's integrator is proportional to its step: 0.0005 rad at 2 kHz.
        let physics_hz = Some(if base.is_fixed() { 10_000 } else { 2000 });
        let config = SimConfig { base, physics_hz, ..config() };
        let mut theirs = python.backend(go2(), config, 1);
        let mut ours = BatchBackend::new(go2(), SimConfig { engine: Engine::Batch, ..config }, 1).unwrap();
        theirs.reset(&[(0, start(base))]).unwrap();
        ours.reset(&[(0, start(base))]).unwrap();
        let ideal = [rows(&mut theirs, base), rows(&mut ours, base)];
        let ideal_difference = rms(&ideal[0], &ideal[1]);
        let tested = |effect: &&&Effect| {
            (effect.target == Target::Joints) == base.is_fixed() && !log_effects.contains(&effect.name)
        };
        for effect in CATALOGUE.iter().filter(tested) {
            let model = apply_effects(&go2(), &[entry(effect)]).unwrap();
            match theirs.reset_with_model(0, &model, &start(base)) {
                Ok(()) => {}
                Err(error) => {
                    let engine = "mujoco";
                    assert_eq!(error, BackendError::UnsupportedEffect { robot: 0, engine, effect: effect.name });
                    rejected.push(effect.name);
                    continue;
                }
            }
            ours.reset_with_model(0, &model, &start(base)).unwrap();
            let (theirs, ours) = (rows(&mut theirs, base), rows(&mut ours, base));
            let (difference, changed) = (rms(&theirs, &ours), rms(&theirs, &ideal[0]));
            println!(
                "{:<20} change {changed:.5}, difference {difference:.5}, ideal {ideal_difference:.5}",
                effect.name
            );
            assert!(changed > 3.0 * ideal_difference, "`{}`: change {changed}", effect.name);
            let bound = 0.15 * changed + 2.0 * ideal_difference;
            assert!(difference < bound, "`{}`: difference {difference}, change {changed}", effect.name);
        }
    }
    expect![[r#"
        torque_saturation, torque_delay, torque_speed_limit, torque_dead_zone, drive_lag, torque_ripple, backlash, joint_elasticity, stribeck_friction, load_friction"#]]
    .assert_eq(&rejected.join(", "));
}

#[test]
fn only_the_robot_that_diverged_is_named_and_it_recovers_at_its_reset() {
    let Some(python) = Interpreter::of_tests() else { return };
    let mut backend = python.backend(go2(), config(), 3);
    let pose = go2().control.default_pose_f32();
    let mut late = go2();
    late.joints[0].actuator.command_delay = 0.0075;
    // Without a delay a policy step is one request; with one it is a request for each actuator period.
    for model in [go2(), late] {
        for robot in 1..3 {
            backend.reset_with_model(robot, &model, &InitialState::at_rest(0.33, pose)).unwrap();
        }
        backend.reset(&[(0, InitialState::at_rest(0.33, pose))]).unwrap();
        check_divergence(&mut backend);
    }
    let unknown = backend.reset(&[(3, InitialState::at_rest(0.33, pose))]).unwrap_err();
    assert_eq!(unknown, BackendError::RobotOutOfRange { robot: 3, num_robots: 3 });
}

/// Robot 0 moves, robot 1 diverges, robot 2 is not active; then all move.
fn check_divergence(backend: &mut MujocoBackend) {
    let mut commands = [hold(); 3];
    commands[1].tau_ff[4] = f32::NAN;
    let error = backend.step(&commands, &[true, true, false], 4).unwrap_err();
    assert_eq!(error, BackendError::Diverged { robots: vec![(1, "q")] });
    let states = backend.states();
    assert!(states.measured.q[0].iter().all(|q| q.is_finite()));
    assert_eq!((states.measured.stamp[0], states.measured.stamp[2]), (0.02, 0.0));
    assert_eq!(states.measured.q[2], go2().control.default_pose_f32(), "an inactive robot does not change");
    backend.reset(&[(1, InitialState::at_rest(0.33, go2().control.default_pose_f32()))]).unwrap();
    backend.step(&[hold(); 3], &[true; 3], 4).unwrap();
    assert_eq!(backend.states().measured.stamp, [0.04, 0.02, 0.02]);
}

#[test]
fn killed_process_is_an_error_of_every_later_request() {
    let Some(python) = Interpreter::of_tests() else { return };
    let walk = Walk::new(WalkConfig::default(), &go2(), true).unwrap();
    let settings = TaskEnvConfig::new(AutoresetMode::NextStep, 1);
    let backend = python.backend(go2(), config(), 1);
    let id = backend.process_id().to_string();
    let mut env = TaskEnv::new(backend, walk, settings).unwrap();
    env.reset(&ResetRequest::seeded(7, 1)).unwrap();
    let killer = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(50));
        run(std::process::Command::new("kill").args(["-KILL", &id])).unwrap();
    });
    let error = loop {
        if let Err(error) = env.step(&[0.0; NUM_JOINTS]) {
            break error;
        }
    };
    killer.join().unwrap();
    let EnvError::Backend(BackendError::EngineProcess { engine: "mujoco", reason }) = &error else { panic!("{error}") };
    assert_eq!(reason, "it ended (signal: 9 (SIGKILL)); its messages are on stderr");
    let again = env.reset(&ResetRequest::seeded(7, 1)).unwrap_err();
    assert_eq!(again.to_string(), error.to_string());
}

#[test]
fn modules_of_the_current_folder_are_not_run() {
    let folder = tempfile::tempdir().unwrap();
    let Some(python) = Interpreter::in_folder(folder.path()) else { return };
    for module in ["twinstep.py", "mujoco.py", "numpy.py"] {
        std::fs::write(folder.path().join(module), "raise SystemExit('a stranger is running')").unwrap();
    }
    python.backend(go2(), config(), 1);
}

fn check_error(python: &Path, robot: RobotModel, config: SimConfig, message: &Expect) {
    let error = MujocoBackend::with_python(robot, config, 1, python).err().unwrap().to_string();
    message.assert_eq(&error.replace(python.to_str().unwrap(), "PYTHON"));
}

#[test]
fn interpreter_that_cannot_run_the_module_is_an_error_that_says_how_to_install_it() {
    check_error(
        Path::new("/nowhere/python3"),
        go2(),
        config(),
        &expect![[r#"
            cannot start `PYTHON -m twinstep.mujoco`, the process of engine `mujoco`: the interpreter does not start: No such file or directory (os error 2)
              install it with `pip install "twinstep[mujoco]"`, or select another Python with TWINSTEP_PYTHON=PATH"#]],
    );
    check_error(
        &Interpreter::script("echo \"No module named $2\" >&2; exit 1").path(),
        go2(),
        config(),
        &expect![[r#"
        cannot start `PYTHON -m twinstep.mujoco`, the process of engine `mujoco`: it ended (exit status: 1); its messages are on stderr
          install it with `pip install "twinstep[mujoco]"`, or select another Python with TWINSTEP_PYTHON=PATH"#]],
    );
}

#[test]
fn output_that_is_no_reply_is_an_error() {
    let reason = |commands: &str| {
        let script = Interpreter::script(commands);
        match MujocoBackend::with_python(go2(), config(), 1, &script.path()).err() {
            Some(BackendBuildError::Mujoco { reason, .. }) => reason,
            other => panic!("{other:?}"),
        }
    };
    let reasons = [
        reason("echo Traceback; exec sleep 9"),
        reason(r"printf '\005\000\000\000Habcd'; exec sleep 9"),
        reason(r"printf '\002\000\000\000Da'; exec sleep 9"),
        reason(r"printf '\005\000\000\000Ha'"),
        reason(r"printf '\023\000\000\000Htwinstep-mujoco 3 \002\000\000\000Da'; exec cat > /dev/null"),
    ];
    expect![[r#"
        it wrote "Trac", which is not the start of a frame
        it is another version: it wrote "abcd", not `twinstep-mujoco 3`
        it wrote a frame of kind 'D' with 1 bytes as a reply
        it ended (exit status: 0); its messages are on stderr
        the process of engine `mujoco` failed: it wrote the states of its robots in 1 bytes; 260 are expected; its robots are lost, create them again"#]].assert_eq(&reasons.join("\n"));
}

#[test]
fn effect_that_mujoco_does_not_have_is_rejected_before_its_process_starts() {
    let mut robot = go2();
    robot.joints[5].actuator.backlash = 0.01;
    let nowhere = Path::new("/nowhere/python3");
    check_error(
        nowhere,
        robot,
        config(),
        &expect!["engine `mujoco` cannot simulate the effect `backlash` of the robot's model; use `batch` or `rapier`"],
    );
}

#[test]
fn shipped_policy_walks_in_mujoco_under_every_condition() {
    let Some(python) = Interpreter::of_tests() else { return };
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let policy = root().join("data/policies/walk_robust.safetensors");
    let output = std::process::Command::new(program)
        .env("TWINSTEP_PYTHON", python.path())
        .args(["evaluate-policy", policy.to_str().unwrap(), "--engine", "mujoco"])
        .args(["--robots", "4", "--seconds", "4", "--json"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let conditions: Vec<_> = rows.iter().map(|row| row["condition"].as_str().unwrap()).collect();
    assert_eq!(conditions, ["nominal", "robots", "pushes", "noise", "ground", "steps", "delay", "robust"]);
    for row in rows {
        // A robot that stands still has 0.65 m/s.
        assert!(row["up"].as_f64().unwrap() > 0.7 && row["velocity_rms"].as_f64().unwrap() < 0.4, "{row}");
    }
}

/// Returns the ids of the child processes of `process`.
fn children(process: u32) -> Vec<String> {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let lists = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("children")).unwrap_or_default());
    lists.flat_map(|list| list.split_whitespace().map(str::to_owned).collect::<Vec<_>>()).collect()
}

/// Joints whose friction exceeds the actuator torque do not move.
#[test]
fn served_robots_have_the_friction_of_the_model_file_and_end_with_a_killed_server() {
    let Some(python) = Interpreter::of_tests() else { return };
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let folder = python.0.path();
    std::fs::write(folder.join("server.toml"), "[sim]\nengine = \"mujoco\"\n").unwrap();
    let friction = "robot = \"go2\"\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"all\"\ntorque_nm = 20.0\n";
    std::fs::write(folder.join("stiff.toml"), friction).unwrap();
    let moved = |model: &[&str]| {
        let interpreter = format!("TWINSTEP_PYTHON={}", python.path().display());
        let program = programs.twinstep().display().to_string();
        let config = folder.join("server.toml").display().to_string();
        let serve = [&interpreter, &program, "serve", "--listen", "tcp/127.0.0.1:0", "--config", &config];
        let arguments: Vec<_> = serve.iter().chain(model).map(|word| (*word).to_owned()).collect();
        let (mut server, endpoint) = Process::listening(Path::new("env"), &arguments).unwrap();
        let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
        let before = env.reset(&ResetRequest::seeded(1, 2)).unwrap()[9..21].to_vec();
        let mut after = before.clone();
        for _ in 0..5 {
            after = env.step(&[0.3; 2 * NUM_JOINTS]).unwrap().obs[9..21].to_vec();
        }
        let simulators = children(server.id());
        assert!(!simulators.is_empty());
        server.kill();
        let since = Instant::now();
        while simulators.iter().any(|id| Path::new(&format!("/proc/{id}/exe")).exists()) {
            assert!(since.elapsed() < Duration::from_secs(20), "{simulators:?} run without their server");
            std::thread::sleep(Duration::from_millis(20));
        }
        before.iter().zip(after).map(|(before, after)| (before - after).abs()).fold(0.0, f32::max)
    };
    let stiff = folder.join("stiff.toml").display().to_string();
    let (free, stuck) = (moved(&[]), moved(&["--model", &stiff]));
    assert!(free > 0.05 && stuck < 0.2 * free, "{free} and {stuck} rad");
}

#[test]
fn played_motion_agrees_with_the_batch_engine() {
    let Some(python) = Interpreter::of_tests() else { return };
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let source = python.0.path().join("sway.csv");
    crate::play::motion(BaseMount::Floating, 0.02).write(&source).unwrap();
    let [ours, theirs] = ["batch", "mujoco"].map(|engine| {
        let out = python.0.path().join(format!("{engine}.csv"));
        let mut play = std::process::Command::new(programs.twinstep());
        play.arg("play").arg(&source).args(["--engine", engine, "--out"]).arg(&out);
        run(play.env("TWINSTEP_PYTHON", python.path())).unwrap();
        let log = Log::open(&out).unwrap();
        let q = |row| twinstep_model::JOINT_NAMES.map(|name| log.q(name).unwrap()[row] as f32);
        ((0..log.rows()).map(q).collect::<Vec<_>>(), log.meta().source.clone().unwrap())
    });
    let difference = rms(&ours.0, &theirs.0);
    assert!(difference < 0.005, "{difference} rad");
    assert_eq!(theirs.1, "twinstep play: `go2` simulated by mujoco at 1000 Hz x 64");
}

/// The plant of the blind test computes its torques by equations of its own.
#[test]
fn plant_of_the_blind_test_moves_like_the_model_with_the_same_effects() {
    let Some(interpreter) = Interpreter::of_tests() else { return };
    let hidden: [(&str, &str, &[f64]); 6] = [
        ("coulomb_friction", "thigh", &[0.5]),
        ("viscous_friction", "calf", &[0.2]),
        ("torque_delay", "hip", &[0.004]),
        ("drive_lag", "RR", &[0.005]),
        ("torque_gain", "FL_calf", &[0.85]),
        ("torque_ripple", "FR_thigh", &[0.6, 8.0, 0.3]),
    ];
    let wave = |period: usize| 0.3 * (0.03 * period as f32).sin();
    let [error, moved] = difference_of_plant_and_model(&interpreter, &hidden, 30.0, wave);
    assert!(error < 0.003 && moved > 0.1, "difference {error} rad of {moved} rad");
}

/// Where backlash closes, the gear transmits more than the motor's torque limit.
#[test]
fn gear_of_the_plant_is_not_limited_to_the_torque_of_the_motor() {
    let Some(interpreter) = Interpreter::of_tests() else { return };
    let square_wave = |period: usize| if (period / 60).is_multiple_of(2) { 0.25 } else { -0.25 };
    let hidden: [(&str, &str, &[f64]); 1] = [("backlash", "hip", &[0.017])];
    let [error, moved] = difference_of_plant_and_model(&interpreter, &hidden, 67.0, square_wave);
    assert!(error < 0.005 && moved > 0.1, "difference {error} rad of {moved} rad");
}

/// Moves all joints of a hanging robot with the effects `hidden` in the plant and in the batch engine for 2 s. Returns the
/// RMS of the difference and of the motion [rad].
fn difference_of_plant_and_model(
    interpreter: &Interpreter,
    hidden: &[(&str, &str, &[f64])],
    kp: f32,
    wave: impl Fn(usize) -> f32,
) -> [f64; 2] {
    let entry = |(name, scope, values): &(&str, &str, &[f64])| {
        EffectEntry::new(Effect::named(name).unwrap(), scope.parse().unwrap(), values.to_vec()).unwrap()
    };
    let effects: Vec<EffectEntry> = hidden.iter().map(entry).collect();
    let mut robot = apply_effects(&go2(), &effects).unwrap();
    robot.control.actuator_hz = 200.0;
    let config = SimConfig { base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let mut model = BatchBackend::new(robot.clone(), config, 1).unwrap();
    let mut plant = MujocoPlant::with_python(robot, config, 1, &interpreter.path()).unwrap();
    let pose = go2().control.default_pose_f32();
    let initial_state = InitialState::at_rest(0.6, pose);
    model.reset(&[(0, initial_state)]).unwrap();
    plant.reset(&[(0, initial_state)]).unwrap();
    let mut sums = [0.0; 2];
    for period in 0..400 {
        let command = Command::hold(pose.map(|q| q + wave(period)), kp, 0.8);
        for backend in [&mut model as &mut dyn Backend, &mut plant] {
            backend.step(&[command], &[true], 1).unwrap();
        }
        let both = model.measured().q[0].iter().zip(&plant.measured().q[0]);
        for ((one, other), rest) in both.zip(&pose) {
            sums[0] += f64::from(one - other).powi(2);
            sums[1] += f64::from(one - rest).powi(2);
        }
    }
    let [error, moved] = sums.map(|sum| (sum / (400 * NUM_JOINTS) as f64).sqrt());
    println!("difference {error:.5} rad of {moved:.3} rad");
    [error, moved]
}

#[test]
fn robots_of_the_plant_do_not_influence_each_other_and_stay_within_the_saturation() {
    let Some(interpreter) = Interpreter::of_tests() else { return };
    let saturation =
        EffectEntry::new(Effect::named("torque_saturation").unwrap(), "all".parse().unwrap(), vec![8.0]).unwrap();
    let robot = apply_effects(&go2(), &[saturation]).unwrap();
    let config = SimConfig { threads: 1, ..SimConfig::default() };
    let plant = |robots| MujocoPlant::with_python(robot.clone(), config, robots, &interpreter.path()).unwrap();
    let (mut both, mut single) = (plant(2), plant(1));
    let pose = go2().control.default_pose_f32();
    let start = InitialState::at_rest(0.33, pose);
    both.reset(&[(0, start), (1, start)]).unwrap();
    single.reset(&[(0, start)]).unwrap();
    let mut largest = 0.0_f32;
    for period in 0..100 {
        let command = |size: f32| Command::hold(pose.map(|q| q + size * (0.1 * period as f32).sin()), 60.0, 0.8);
        both.step(&[command(0.1), command(0.5)], &[true, period < 50], 1).unwrap();
        single.step(&[command(0.1)], &[true], 1).unwrap();
        assert_eq!(both.measured().q[0], single.measured().q[0], "period {period}");
        assert_eq!(both.measured().tau[0], single.measured().tau[0], "period {period}");
        largest = both.measured().tau[1].iter().fold(largest, |largest, tau| largest.max(tau.abs()));
    }
    assert!((7.0..=8.0).contains(&largest), "{largest} N·m");
    assert_ne!(both.measured().q[0], both.measured().q[1]);
    assert!((both.measured().stamp[0] - 0.5).abs() < 1e-9 && (both.measured().stamp[1] - 0.25).abs() < 1e-9);
}
