//! Robots that an ensemble actuators: in both engines, through the server, and through the other programs that take a model.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_effects::{ActuatorNetworkConfig, MemberSampling, ModelFile};
use twinstep_ensemble::{ActuatorNetworkRobot, Ensemble, EnsembleMetadata, JointEncoding, Normaliser, Normalisers};
use twinstep_env_server::{Config, EnvFactory, EnvFactoryError, SimEnvFactory};
use twinstep_envs::{TaskName, walk_spec};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{
    AutoresetMode, Backend, BackendError, BaseMount, Command as RobotCommand, InitialState, JOINT_NAMES, ResetRequest,
    StepBatch, VecEnv, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;

use crate::remote;

const ENVS: usize = 5;

/// What a small ensemble for the Go2 depends on.
fn description() -> EnsembleMetadata {
    let scale = |deviation| Normaliser { mean: 0.0, std: deviation };
    EnsembleMetadata {
        members: 3,
        hidden: 6,
        dt: 0.005,
        joints: JOINT_NAMES.map(str::to_owned).to_vec(),
        joint_input: JointEncoding::Kind,
        scales: Normalisers { errors: [scale(0.1), scale(2.0)], torque: scale(15.0) },
        tau_sensor: TorqueSensor::MotorCurrent,
        gains: vec![[30.0, 0.75]; 12],
        variance_scale: 0.05,
        data_hash: String::new(),
        seed: 1,
    }
}

/// A folder with an ensemble and a model file that names it, with more lines under `[actuator]` and before it.
fn model_with(description: EnsembleMetadata, effects: &str, keys: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    Ensemble::untrained(description).write(folder.path().join("actuators.safetensors")).unwrap();
    let actuator = format!("[actuator]\nensemble = \"actuators.safetensors\"\n{keys}\n");
    std::fs::write(&path, format!("robot = \"go2\"\n{effects}\n{actuator}")).unwrap();
    (folder, path)
}

fn config(engine: Engine, model: &Path, threads: usize) -> Config {
    let mut config = remote::config(TaskName::Walk);
    (config.sim.engine, config.sim.threads) = (engine, threads);
    config.server.model = Some(model.to_owned());
    config.task.min_base_height_m = -1.0;
    config.task.max_tilt_rad = 3.2;
    config
}

fn envs(config: &Config, num_envs: usize) -> Box<dyn VecEnv> {
    SimEnvFactory::new(config.clone()).unwrap().build(num_envs, AutoresetMode::NextStep, Some(6)).unwrap()
}

/// Steps of environments that are seeded from `seed`; environment by environment the same actions.
fn episode(env: &mut dyn VecEnv, seed: u64) -> Vec<StepBatch> {
    let num_envs = env.num_envs();
    env.reset(&ResetRequest::seeded(seed, num_envs)).unwrap();
    let action = |step: usize| (0..12).map(move |joint| (0.7 * step as f32 + joint as f32).sin());
    (0..14).map(|step| env.step(&action(step).collect::<Vec<_>>().repeat(num_envs)).unwrap().clone()).collect()
}

#[test]
fn environment_of_a_batch_is_the_single_one_of_its_seed() {
    for keys in ["draw = \"episode\"\nsample = true", "draw = \"step\""] {
        let (_folder, model) = model_with(description(), "", keys);
        for engine in [Engine::Batch, Engine::Rapier] {
            let many = episode(envs(&config(engine, &model, 2), ENVS).as_mut(), 40);
            for env in 0..ENVS {
                let single = episode(envs(&config(engine, &model, 1), 1).as_mut(), 40 + env as u64);
                for (step, (one, many)) in single.iter().zip(&many).enumerate() {
                    let own = &many.obs[env * one.obs.len()..(env + 1) * one.obs.len()];
                    assert!(own == one.obs, "{engine:?}, {keys}, environment {env}, step {step}");
                    assert_eq!(many.reward[env], one.reward[0]);
                }
            }
            let first = |env: usize| &many[5].obs[env * many[5].obs.len() / ENVS..][..12];
            assert_ne!(first(0), first(1));
        }
    }
}

#[test]
fn uncertainty_is_a_reward_and_changes_no_motion() {
    let (_folder, model) = model_with(description(), "", "");
    let plain = config(Engine::Batch, &model, 1);
    let mut curious = plain.clone();
    curious.task.reward.epistemic_uncertainty = 2.0;
    let [plain, curious] = [plain, curious].map(|config| episode(envs(&config, ENVS).as_mut(), 3));
    for (plain, curious) in plain.iter().zip(&curious) {
        assert_eq!(plain.obs, curious.obs);
        for (env, (without, with)) in plain.reward.iter().zip(&curious.reward).enumerate() {
            // Untrained members disagree; the step in which an episode starts anew has no reward.
            assert!(with > without || *with == 0.0, "environment {env}: {without} {with}");
        }
    }
    assert!(curious[3].reward.iter().zip(&plain[3].reward).all(|(with, without)| with > without));
}

/// Largest difference of a standing robot's joints [rad], and of its torques [N·m], from those of its own actuators.
fn away_from_own_drives(tau_sensor: TorqueSensor) -> [f32; 2] {
    let description = EnsembleMetadata { tau_sensor, ..description() };
    let settings = ActuatorNetworkConfig { ensemble: PathBuf::new(), draw: MemberSampling::PerStep, sample: false };
    let learned = ActuatorNetworkRobot::new(&ModelFile::default(), Ensemble::linear_pd(description), settings).unwrap();
    let sim = SimConfig { engine: Engine::Batch, threads: 1, ..SimConfig::default() };
    let own = BatchBackend::new(go2(), sim, 1).unwrap();
    let backend = BatchBackend::new(learned.robot.clone(), sim, 1).unwrap();
    let pose = go2().control.default_pose_f32();
    let [own, other] = [own, backend.with_actuator(Box::new(learned.actuators(1, false)))].map(|mut backend| {
        backend.reset(&[(0, InitialState::at_rest(0.34, pose))]).unwrap();
        let command = RobotCommand::hold(pose.map(|q| q + 0.05), 30.0, 0.75);
        backend.step(&[command], &[true], 200).unwrap();
        let states = backend.states();
        assert!(states.base_position[0][2] > 0.25, "{:?}", states.base_position);
        [states.q[0], states.tau[0]]
    });
    [0, 1].map(|quantity| {
        own[quantity].iter().zip(&other[quantity]).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    })
}

#[test]
fn robot_stands_on_networks_that_know_its_gains() {
    let [q, tau] = away_from_own_drives(TorqueSensor::MotorCurrent);
    // The networks bend by some percent of the torque, and differ by one.
    assert!(q < 0.02 && tau < 0.7, "{q} rad, {tau} N·m");
    // Without the rotor, which its own actuators have, it stands alike.
    let [q, tau] = away_from_own_drives(TorqueSensor::JointOutput);
    assert!(q < 0.02 && tau < 0.7, "{q} rad, {tau} N·m");
}

#[test]
fn rotor_is_in_what_was_learnt_behind_it() {
    for (tau_sensor, rotor) in
        [(TorqueSensor::MotorCurrent, go2().joints[0].armature), (TorqueSensor::JointOutput, 0.0)]
    {
        let (_folder, model) = model_with(EnsembleMetadata { tau_sensor, ..description() }, "", "");
        let learned = ActuatorNetworkRobot::load(&ModelFile::load(&model).unwrap()).unwrap().unwrap();
        assert!(learned.robot.joints.iter().all(|joint| joint.armature == rotor));
        let mut config = config(Engine::Batch, &model, 1);
        config.randomise.effects = true;
        assert_eq!(SimEnvFactory::new(config).is_ok(), rotor > 0.0);
    }
}

/// Steps that robots take from where they are, two of them together.
fn steps<B: Backend>(backend: &mut B, active: [bool; 2]) -> Vec<Vec<f32>> {
    let control = go2().control;
    let hold = RobotCommand::hold(control.default_pose_f32(), control.kp as f32, control.kd as f32);
    let mut seen = Vec::new();
    for _ in 0..6 {
        backend.step(&[hold; 2], &active, 3).unwrap();
        let states = backend.states();
        seen.extend((0..2).map(|robot| {
            [&states.q[robot][..], &states.tau[robot], &states.epistemic_uncertainty[robot..][..1]].concat()
        }));
    }
    seen
}

fn check_snapshots<B: Backend>(mut backend: B) {
    let placement =
        |seed| InitialState { actuator_seed: seed, ..InitialState::at_rest(0.34, go2().control.default_pose_f32()) };
    backend.reset(&[(0, placement(7)), (1, placement(8))]).unwrap();
    steps(&mut backend, [true, true]);
    let kept = [0, 1].map(|robot| backend.snapshot(robot));
    let first = steps(&mut backend, [true, true]);
    // Another member may actuator robot 0 by now; what stands still stays as it is, in its actuators too.
    backend.reset(&[(0, placement(9))]).unwrap();
    steps(&mut backend, [true, false]);
    (0..2).for_each(|robot| backend.restore(robot, &kept[robot]));
    assert!(steps(&mut backend, [true, true]) == first);
    // Either state in either place.
    (0..2).for_each(|robot| backend.restore(robot, &kept[1 - robot]));
    let swapped = steps(&mut backend, [true, true]);
    assert!(swapped.iter().zip(first.chunks(2).flat_map(|both| both.iter().rev())).all(|(one, other)| one == other));

    (0..2).for_each(|robot| backend.restore(robot, &kept[robot]));
    steps(&mut backend, [true, false]);
    backend.restore(0, &kept[0]);
    assert!(steps(&mut backend, [true, true]) == first);

    backend.reset(&[(0, placement(7)), (1, placement(8))]).unwrap();
    let anew = steps(&mut backend, [true, true]);
    backend.reset(&[(0, placement(7)), (1, placement(8))]).unwrap();
    assert!(steps(&mut backend, [true, true]) == anew && anew != first);
}

#[test]
fn drives_go_back_with_the_robots_snapshot() {
    for (keys, uncertain) in [("sample = true", false), ("", true), ("draw = \"step\"", false)] {
        let (_folder, model) = model_with(description(), "", keys);
        let learned = ActuatorNetworkRobot::load(&ModelFile::load(&model).unwrap()).unwrap().unwrap();
        let sim = |engine| SimConfig { engine, threads: 1, ..SimConfig::default() };
        let actuators = || Box::new(learned.actuators(2, uncertain));
        let robot = || learned.robot.clone();
        check_snapshots(BatchBackend::new(robot(), sim(Engine::Batch), 2).unwrap().with_actuator(actuators()));
        check_snapshots(RapierBackend::new(robot(), sim(Engine::Rapier), 2).unwrap().with_actuator(actuators()));
    }
}

#[test]
fn commands_that_no_network_has_heard_of_are_refused_and_nothing_is_stepped() {
    let (_folder, model) = model_with(description(), "", "");
    let learned = ActuatorNetworkRobot::load(&ModelFile::load(&model).unwrap()).unwrap().unwrap();
    let sim = SimConfig { engine: Engine::Batch, threads: 1, ..SimConfig::default() };
    let mut backend = BatchBackend::new(go2(), sim, 2).unwrap().with_actuator(Box::new(learned.actuators(2, false)));
    let known = RobotCommand::hold(go2().control.default_pose_f32(), 30.0, 0.75);
    let before = backend.states().clone();
    let pushed = RobotCommand { tau_ff: std::array::from_fn(|joint| if joint == 4 { 1.5 } else { 0.0 }), ..known };
    let soft = RobotCommand::hold(known.q, 20.0, 0.75);
    for (command, reason) in [(pushed, "FR_thigh has 1.5"), (soft, "FL_hip has [20.0, 0.75]")] {
        let error = backend.step(&[known, command], &[true, true], 4).unwrap_err();
        assert!(
            matches!(error, BackendError::UnsupportedCommand { robot: 1, .. }) && error.to_string().contains(reason),
            "{error}"
        );
        assert_eq!(*backend.states(), before);
        backend.step(&[known, command], &[false, false], 4).unwrap();
    }
}

fn twinstep(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.0.join("twinstep")).args(arguments).output().unwrap()
}

/// What a program says of a model that it refuses.
fn refusal(program: &[&str], model: &Path) -> String {
    let output = twinstep(&[program, &["--model", model.to_str().unwrap()]].concat());
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{error}");
    error
}

#[test]
fn serve_drives_robots_by_the_ensemble_of_its_model() {
    let (_folder, model) = model_with(description(), "", "sample = true");
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "8", "--model", model.to_str().unwrap()];
    let (_server, endpoint) = Process::listening(&programs.0.join("twinstep"), &arguments.map(str::to_owned)).unwrap();
    let options = ConnectOptions { max_episode_steps: Some(6), ..ConnectOptions::new(&endpoint, ENVS) };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut default = Config::default();
    default.server.model = Some(model);
    let first = episode(&mut remote, 21);
    assert_eq!(first, episode(envs(&default, ENVS).as_mut(), 21));
    assert_eq!(first, episode(&mut remote, 21));
    assert_ne!(first, episode(envs(&Config::default(), ENVS).as_mut(), 21));
}

#[test]
fn served_robot_has_the_gains_that_its_ensemble_learnt_with_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("robot.toml");
    let soft = EnsembleMetadata { gains: vec![[25.0, 0.6]; 12], ..description() };
    Ensemble::linear_pd(soft).write(folder.path().join("actuators.safetensors")).unwrap();
    std::fs::write(&model, "robot = \"go2\"\n[actuator]\nensemble = \"actuators.safetensors\"").unwrap();
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "2", "--model", model.to_str().unwrap()];
    let (_server, endpoint) = Process::listening(&programs.0.join("twinstep"), &arguments.map(str::to_owned)).unwrap();
    let mut remote = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
    let nominal = walk_spec(&go2(), &Config::default().task);
    let spec = remote.spec().clone();
    assert_eq!([spec.kp, spec.kd], [25.0, 0.6]);
    assert_ne!(spec.hash(), nominal.hash());
    remote.reset(&ResetRequest::seeded(3, 2)).unwrap();
    for step in 0..50 {
        let batch = remote.step(&[0.0; 24]).unwrap();
        assert!(batch.terminated.iter().all(|fell| !fell), "step {step}");
    }
}

#[test]
fn ensembles_that_do_not_go_with_the_robot_are_refused_with_the_reason() {
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0"];
    let lag = "[[effect]]\nname = \"drive_lag\"\nscope = \"all\"\ntime_constant_s = 0.01";
    let ripple = "[[effect]]\nname = \"coulomb_friction\"\nscope = \"calf\"\ntorque_nm = 0.2";
    let slow = EnsembleMetadata { dt: 0.02, ..description() };
    let mut uneven = description();
    uneven.gains[4] = [20.0, 0.5];
    let behind = EnsembleMetadata { tau_sensor: TorqueSensor::JointOutput, ..description() };
    let hip = EnsembleMetadata {
        joints: vec!["FL_hip".to_owned()],
        gains: vec![[30.0, 0.75]],
        joint_input: JointEncoding::Identity,
        ..description()
    };
    for (description, effects, reason) in [
        (slow, "", "`actuator.ensemble`: the robot's actuator has a time step of 0.005 s, the model one of 0.02 s"),
        (uneven, "", "trained for FL_hip with kp 30 and kd 0.75, for FR_thigh with kp 20 and kd 0.5; a robot has one"),
        (
            description(),
            lag,
            "`drive_lag` on all is part of this ensemble, which is trained on the torque at `current`",
        ),
        (behind, ripple, "replaces stages 1 to 14 of the chain, including `coulomb_friction` (13, friction)"),
        (hip, "", "is not trained for FL_thigh"),
    ] {
        let (_folder, model) = model_with(description, effects, "");
        let error = refusal(&serve, &model);
        assert!(error.contains(reason), "{error}");
    }
    // Behind the current there is friction.
    let (_folder, model) = model_with(description(), ripple, "");
    assert!(SimEnvFactory::new(config(Engine::Batch, &model, 1)).is_ok());
}

#[test]
fn settings_that_learned_drives_cannot_follow_are_refused_by_name() {
    let (_folder, model) = model_with(description(), "", "");
    let refused = |change: fn(&mut Config), expected: &str| {
        let mut config = config(Engine::Batch, &model, 1);
        change(&mut config);
        let error = SimEnvFactory::new(config).err().unwrap();
        assert!(matches!(error, EnvFactoryError::ActuatorNetwork { field, .. } if field == expected), "{error}");
    };
    refused(|config| config.randomise.kp_scale = [0.9, 1.1], "randomise.kp_scale");
    refused(|config| config.randomise.kd_scale = [0.9, 0.9], "randomise.kd_scale");
    refused(
        |config| {
            config.server.model = None;
            config.task.reward.epistemic_uncertainty = 1.0;
        },
        "task.reward.epistemic_uncertainty",
    );
}

#[test]
fn play_runs_learned_drives_and_who_needs_their_laws_refuses_them() {
    let (folder, model) = model_with(description(), "", "draw = \"step\"");
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let meta = Meta::new(50.0, TorqueSensor::None, vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }]);
    let mut columns = BTreeMap::from([("t".to_owned(), (0..20).map(|row| 0.02 * f64::from(row)).collect())]);
    columns.insert("q_cmd_FL_calf".to_owned(), vec![-1.3; 20]);
    Log::new_commands(meta, columns).unwrap().write(path("sway.csv")).unwrap();
    let play = |out: &str, more: &[&str]| {
        let output = twinstep(&[&["play", &path("sway.csv"), "--out", out], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Log::open(out).unwrap()
    };
    let learned = play(&path("learned"), &["--model", model.to_str().unwrap()]);
    assert_ne!(learned.q("FL_calf"), play(&path("own"), &[]).q("FL_calf"));

    let (log, out) = (path("learned"), path("out"));
    for program in [&["evaluate", &log][..], &["identify", &log, "--out", &out], &["diagnose", &log, "--out", &out]] {
        let error = refusal(program, &model);
        assert!(error.contains("robot.toml: `[actuator]` is for `twinstep serve` and `twinstep play`"), "{error}");
    }
}
