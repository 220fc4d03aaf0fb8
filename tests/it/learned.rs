//! Robots with actuator networks: in both engines, on the server, and with the other commands that take a model.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use rand::RngExt;
use tempfile::TempDir;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_effects::{ActuatorNetworkConfig, MemberSampling, ModelFile};
use twinstep_ensemble::{
    ActuatorNetworkRobot, Ensemble, EnsembleMetadata, JointEncoding, NetworkInput, NetworkTarget, Normaliser,
    Normalisers,
};
use twinstep_env_server::{Config, EnvFactory, EnvFactoryError, SimEnvFactory};
use twinstep_envs::{TaskConfig, base_spec};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{
    AutoresetMode, Backend, BackendError, BaseMount, Command as RobotCommand, InitialState, JOINT_NAMES, ResetRequest,
    Restorable, Simulator, StepBatch, Stream, VecEnv, go2, stream,
};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;

use crate::remote;

const ENVS: usize = 5;

/// Returns the metadata of a small ensemble for the Go2.
fn description() -> EnsembleMetadata {
    let scale = |std| Normaliser { mean: 0.0, std };
    EnsembleMetadata {
        members: 3,
        hidden: 6,
        dt: 0.005,
        joints: JOINT_NAMES.map(str::to_owned).to_vec(),
        joint_input: JointEncoding::Kind,
        input: NetworkInput::default(),
        target: NetworkTarget::default(),
        scales: Normalisers { inputs: [scale(0.1), scale(2.0)], torque: scale(15.0) },
        tau_sensor: TorqueSensor::MotorCurrent,
        gains: vec![[30.0, 0.75]; 12],
        variance_scale: 0.05,
        data_hash: String::new(),
        seed: 1,
    }
}

/// Returns a folder with an ensemble and a model file that refers to it.
///
/// `effects` are lines before `[actuator]`, `keys` are lines below it.
fn model_with(description: EnsembleMetadata, effects: &str, keys: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    Ensemble::untrained(description).write(folder.path().join("actuators.safetensors")).unwrap();
    let actuator = format!("[actuator]\nensemble = \"actuators.safetensors\"\n{keys}\n");
    std::fs::write(&path, format!("robot = \"go2\"\n{effects}\n{actuator}")).unwrap();
    (folder, path)
}

fn config(engine: Engine, model: &Path, threads: usize) -> Config {
    let mut config = remote::config(TaskConfig::default());
    (config.sim.engine, config.sim.threads) = (engine, threads);
    config.server.model = Some(model.to_owned());
    remote::walk(&mut config).min_base_height_m = Some(-1.0);
    remote::walk(&mut config).max_tilt_rad = 3.2;
    config
}

fn envs(config: &Config, num_envs: usize) -> Box<dyn VecEnv> {
    SimEnvFactory::new(config.clone()).unwrap().build(num_envs, AutoresetMode::NextStep, Some(6)).unwrap()
}

/// Returns the steps of environments with seeds from `seed`. All environments receive the same actions.
fn episode(env: &mut dyn VecEnv, seed: u64) -> Vec<StepBatch> {
    let num_envs = env.num_envs();
    env.reset(&ResetRequest::seeded(seed, num_envs)).unwrap();
    let action = |step: usize| (0..12).map(move |joint| (0.7 * step as f32 + joint as f32).sin());
    (0..14).map(|step| env.step(&action(step).collect::<Vec<_>>().repeat(num_envs)).unwrap().clone()).collect()
}

#[test]
fn environment_in_a_batch_equals_the_single_one_with_its_seed() {
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
fn epistemic_uncertainty_reward_does_not_change_the_motion() {
    let (_folder, model) = model_with(description(), "", "");
    let plain = config(Engine::Batch, &model, 1);
    let mut exploring = plain.clone();
    remote::walk(&mut exploring).reward.epistemic_uncertainty = 2.0;
    let [plain, exploring] = [plain, exploring].map(|config| episode(envs(&config, ENVS).as_mut(), 3));
    for (plain, exploring) in plain.iter().zip(&exploring) {
        assert_eq!(plain.obs, exploring.obs);
        for (env, (without, with)) in plain.reward.iter().zip(&exploring.reward).enumerate() {
            // Untrained members have epistemic uncertainty. The step that resets an environment has no reward.
            assert!(with > without || *with == 0.0, "environment {env}: {without} {with}");
        }
    }
    assert!(exploring[3].reward.iter().zip(&plain[3].reward).all(|(with, without)| with > without));
}

/// Returns the largest differences of joint positions [rad] and torques [N·m] between networks and analytic actuators.
///
/// The robot stands on a network that was set up as a linear PD controller.
fn difference_from_analytic_actuators(tau_sensor: TorqueSensor) -> [f32; 2] {
    let description = EnsembleMetadata { tau_sensor, ..description() };
    let settings = ActuatorNetworkConfig { draw: MemberSampling::PerStep, ..ActuatorNetworkConfig::default() };
    let learned = ActuatorNetworkRobot::new(&ModelFile::default(), Ensemble::linear_pd(description), settings).unwrap();
    let sim = SimConfig { engine: Engine::Batch, threads: 1, ..SimConfig::default() };
    let analytic = BatchBackend::new(go2(), sim, 1).unwrap();
    let backend = BatchBackend::new(learned.robot.clone(), sim, 1).unwrap();
    let pose = go2().control.default_pose_f32();
    let network = backend.with_actuator(Box::new(learned.actuators(1, false)));
    let [analytic, network] = [analytic, network].map(|mut backend| {
        backend.reset(&[(0, InitialState::at_rest(0.34, pose))]).unwrap();
        let command = RobotCommand::hold(pose.map(|q| q + 0.05), 30.0, 0.75);
        backend.step(&[command], &[true], 200).unwrap();
        let states = backend.states();
        assert!(states.truth.base_position[0][2] > 0.25, "{:?}", states.truth.base_position);
        [states.measured.q[0], states.measured.tau[0]]
    });
    [0, 1].map(|quantity| {
        analytic[quantity].iter().zip(&network[quantity]).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    })
}

#[test]
fn robot_with_linear_pd_networks_stands_as_with_analytic_actuators() {
    let [q, tau] = difference_from_analytic_actuators(TorqueSensor::MotorCurrent);
    // The networks are nonlinear by a few percent of the torque, and the members differ by one percent.
    assert!(q < 0.02 && tau < 0.7, "{q} rad, {tau} N·m");
    // With an output sensor the network replaces the rotor inertia, which has no effect at rest.
    let [q, tau] = difference_from_analytic_actuators(TorqueSensor::JointOutput);
    assert!(q < 0.02 && tau < 0.7, "{q} rad, {tau} N·m");
}

#[test]
fn ensemble_trained_on_output_torque_replaces_the_rotor_inertia() {
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

/// Steps two robots from their current state and returns positions, torques and uncertainty of each.
fn steps<B: Simulator>(backend: &mut B, active: [bool; 2]) -> Vec<Vec<f32>> {
    let control = go2().control;
    let hold = control.hold(control.default_pose_f32());
    let mut rows = Vec::new();
    for _ in 0..6 {
        backend.step(&[hold; 2], &active, 3).unwrap();
        let states = backend.states();
        rows.extend((0..2).map(|robot| {
            [
                &states.measured.q[robot][..],
                &states.measured.tau[robot],
                &states.truth.epistemic_uncertainty[robot..][..1],
            ]
            .concat()
        }));
    }
    rows
}

fn check_snapshots<B: Restorable>(mut backend: B) {
    let initial_state =
        |seed| InitialState { actuator_seed: seed, ..InitialState::at_rest(0.34, go2().control.default_pose_f32()) };
    backend.reset(&[(0, initial_state(7)), (1, initial_state(8))]).unwrap();
    steps(&mut backend, [true, true]);
    let snapshots = [0, 1].map(|robot| backend.snapshot(robot));
    let first = steps(&mut backend, [true, true]);
    // After this reset another member may be the actuator of robot 0. Inactive robots and their actuators do not
    // change.
    backend.reset(&[(0, initial_state(9))]).unwrap();
    steps(&mut backend, [true, false]);
    (0..2).for_each(|robot| backend.restore(robot, &snapshots[robot]));
    assert!(steps(&mut backend, [true, true]) == first);
    // Each snapshot can be restored to either robot.
    (0..2).for_each(|robot| backend.restore(robot, &snapshots[1 - robot]));
    let swapped = steps(&mut backend, [true, true]);
    assert!(swapped.iter().zip(first.chunks(2).flat_map(|both| both.iter().rev())).all(|(one, other)| one == other));

    (0..2).for_each(|robot| backend.restore(robot, &snapshots[robot]));
    steps(&mut backend, [true, false]);
    backend.restore(0, &snapshots[0]);
    assert!(steps(&mut backend, [true, true]) == first);

    backend.reset(&[(0, initial_state(7)), (1, initial_state(8))]).unwrap();
    let after_reset = steps(&mut backend, [true, true]);
    backend.reset(&[(0, initial_state(7)), (1, initial_state(8))]).unwrap();
    assert!(steps(&mut backend, [true, true]) == after_reset && after_reset != first);
}

#[test]
fn snapshot_includes_the_state_of_the_actuator_networks() {
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
fn commands_outside_the_training_conditions_are_rejected_and_no_robot_is_stepped() {
    let (_folder, model) = model_with(description(), "", "");
    let learned = ActuatorNetworkRobot::load(&ModelFile::load(&model).unwrap()).unwrap().unwrap();
    let sim = SimConfig { engine: Engine::Batch, threads: 1, ..SimConfig::default() };
    let mut backend = BatchBackend::new(go2(), sim, 2).unwrap().with_actuator(Box::new(learned.actuators(2, false)));
    let supported = RobotCommand::hold(go2().control.default_pose_f32(), 30.0, 0.75);
    let before = backend.states().clone();
    let feedforward =
        RobotCommand { tau_ff: std::array::from_fn(|joint| if joint == 4 { 1.5 } else { 0.0 }), ..supported };
    let soft = RobotCommand::hold(supported.q, 20.0, 0.75);
    for (command, reason) in [(feedforward, "FR_thigh has 1.5"), (soft, "FL_hip has [20.0, 0.75]")] {
        let error = backend.step(&[supported, command], &[true, true], 4).unwrap_err();
        assert!(
            matches!(error, BackendError::UnsupportedCommand { robot: 1, .. }) && error.to_string().contains(reason),
            "{error}"
        );
        assert_eq!(*backend.states(), before);
        backend.step(&[supported, command], &[false, false], 4).unwrap();
    }
}

fn twinstep(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.twinstep()).args(arguments).output().unwrap()
}

/// Returns the error of a command that rejects `model`.
fn rejection(command: &[&str], model: &Path) -> String {
    let output = twinstep(&[command, &["--model", model.to_str().unwrap()]].concat());
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{error}");
    error
}

#[test]
fn serve_simulates_robots_with_the_ensemble_of_its_model() {
    let (_folder, model) = model_with(description(), "", "sample = true");
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "8", "--model", model.to_str().unwrap()];
    let (_server, endpoint) = Process::listening(&programs.twinstep(), &arguments.map(str::to_owned)).unwrap();
    let options = ConnectOptions { max_episode_steps: Some(6), critic: true, ..ConnectOptions::new(&endpoint, ENVS) };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut default = Config::default();
    default.server.model = Some(model);
    let first = episode(&mut remote, 21);
    assert_eq!(first, episode(envs(&default, ENVS).as_mut(), 21));
    assert_eq!(first, episode(&mut remote, 21));
    assert_ne!(first, episode(envs(&Config::default(), ENVS).as_mut(), 21));
}

#[test]
fn served_robot_and_its_spec_have_the_gains_of_the_training_data() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("robot.toml");
    let soft = EnsembleMetadata { gains: vec![[25.0, 0.6]; 12], ..description() };
    Ensemble::linear_pd(soft).write(folder.path().join("actuators.safetensors")).unwrap();
    std::fs::write(&model, "robot = \"go2\"\n[actuator]\nensemble = \"actuators.safetensors\"").unwrap();
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "2", "--model", model.to_str().unwrap()];
    let (_server, endpoint) = Process::listening(&programs.twinstep(), &arguments.map(str::to_owned)).unwrap();
    let mut remote = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
    let nominal = base_spec("walk", &go2(), Vec::new(), 20.0);
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
fn ensembles_that_do_not_fit_the_robot_are_rejected_with_the_reason() {
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0"];
    let lag = "[[effect]]\nname = \"drive_lag\"\nscope = \"all\"\ntime_constant_s = 0.01";
    let friction = "[[effect]]\nname = \"coulomb_friction\"\nscope = \"calf\"\ntorque_nm = 0.2";
    let fast = EnsembleMetadata { dt: 0.002, ..description() };
    let residual = EnsembleMetadata { target: NetworkTarget::Residual, ..description() };
    let mut uneven = description();
    uneven.gains[4] = [20.0, 0.5];
    let output = EnsembleMetadata { tau_sensor: TorqueSensor::JointOutput, ..description() };
    let hip = EnsembleMetadata {
        joints: vec!["FL_hip".to_owned()],
        gains: vec![[30.0, 0.75]],
        joint_input: JointEncoding::Identity,
        ..description()
    };
    for (description, effects, reason) in [
        (fast, "", "`actuator.ensemble`: the ensemble computes a torque at 500 Hz, the robot's actuator at 200 Hz"),
        (residual, "", "`actuator.mode`: the ensemble predicts the torque that a model lacks; use mode = \"residual\""),
        (uneven, "", "trained for FL_hip with kp 30 and kd 0.75, for FR_thigh with kp 20 and kd 0.5; a robot has one"),
        (
            description(),
            lag,
            "`drive_lag` on all is part of this ensemble, which is trained on the torque at `current`",
        ),
        (output, friction, "replaces stages 1 to 14 of the chain, including `coulomb_friction` (13, friction)"),
        (hip, "", "is not trained for FL_thigh"),
    ] {
        let (_folder, model) = model_with(description, effects, "");
        let error = rejection(&serve, &model);
        assert!(error.contains(reason), "{error}");
    }
    // With a motor-current sensor, friction is not part of the ensemble.
    let (_folder, model) = model_with(description(), friction, "");
    assert!(SimEnvFactory::new(config(Engine::Batch, &model, 1)).is_ok());
}

/// Runs `twinstep train` with few robots and steps.
fn train(folder: &Path, arguments: &[&str]) -> Output {
    let out = folder.join("out");
    Command::new(Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep())
        .args(["train", "--out", out.to_str().unwrap(), "--envs", "16", "--steps", "384"])
        .args(arguments)
        .output()
        .unwrap()
}

#[test]
fn residual_that_was_trained_with_a_base_policy_is_written_with_it_as_one_policy() {
    let (folder, model) = model_with(description(), "", "");
    let model = model.to_str().unwrap();
    let base_path = twinstep_tests::python::root().join("data/policies/walk.safetensors");
    let trained = train(folder.path(), &["explore", "--base", base_path.to_str().unwrap(), "--model", model]);
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    let read = |name: &str| Policy::read(folder.path().join("out").join(name)).unwrap().0;
    let (base, residual, whole) =
        (Policy::read(base_path).unwrap().0, read("policy.safetensors"), read("exploration.safetensors"));
    assert_eq!((residual.spec.task.as_str(), &whole.spec), ("explore", &base.spec));
    let mut random = stream(4, "observations", 0);
    // The normalisers clip entries that are ten standard deviations from their mean, each its own.
    let entry = |random: &mut Stream, index: usize| {
        let of = |policy: &Policy| policy.normaliser.mean_and_std();
        let ((base_mean, base_std), (mean, std)) = (of(&base), of(&residual));
        let value = base_mean[index] + base_std[index] * random.random_range(-2.0..2.0);
        value.clamp(mean[index] - 9.0 * std[index], mean[index] + 9.0 * std[index])
    };
    let obs: Vec<f32> = (0..64 * 45).map(|i| entry(&mut random, i % 45)).collect();
    let [base, residual, whole] = [base, residual, whole].map(|policy| {
        let mut actions = vec![0.0; 64 * 12];
        PolicyRunner::new(&policy).run(&obs, &mut actions);
        actions
    });
    for (whole, (base, residual)) in whole.iter().zip(base.iter().zip(&residual)) {
        let expected = base + 0.5 * residual.clamp(-1.0, 1.0);
        assert!((whole - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{whole} {expected}");
    }
    let errors = [
        (vec!["explore", "--model", model], "`task.base` = \"\" is not allowed"),
        (vec!["explore", "--base", "none.safetensors", "--model", model], "`task.base`"),
        (vec!["walk", "--base", "none.safetensors"], "`--base` is for the task `explore`"),
        (vec!["explore", "--base", "README.md"], "`task.uncertainty_weight`"),
    ];
    for (arguments, expected) in errors {
        let folder = tempfile::tempdir().unwrap();
        let refused = train(folder.path(), &arguments);
        let text = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(2) && text.contains(expected), "{arguments:?}: {text}");
    }
}

#[test]
fn residual_is_trained_on_the_robots_of_a_server_that_has_the_networks() {
    let (folder, model) = model_with(description(), "", "");
    let base = twinstep_tests::python::root().join("data/policies/walk.safetensors");
    let config = folder.path().join("server.toml");
    std::fs::write(&config, format!("[task]\nname = \"explore\"\nbase = \"{}\"\n", base.display())).unwrap();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "320", "--task", "explore"];
    let files = ["--config", config.to_str().unwrap(), "--model", model.to_str().unwrap()];
    let serve: Vec<String> = serve.iter().chain(&files).map(ToString::to_string).collect();
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let (_server, endpoint) = Process::listening(&program, &serve).unwrap();
    let without = train(folder.path(), &["explore", "--endpoint", &endpoint]);
    let text = String::from_utf8_lossy(&without.stderr).into_owned();
    assert!(without.status.code() == Some(2) && text.contains("`--base` is missing"), "{text}");
    let trained = train(folder.path(), &["explore", "--endpoint", &endpoint, "--base", base.to_str().unwrap()]);
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    let out = folder.path().join("out");
    assert_eq!(Policy::read(out.join("policy.safetensors")).unwrap().0.spec.task, "explore");
    assert!(out.join("exploration.safetensors").exists() && out.join("evaluation.json").exists());
}

#[test]
fn settings_that_actuator_networks_do_not_support_are_rejected_by_name() {
    let (_folder, model) = model_with(description(), "", "");
    let check = |change: fn(&mut Config), expected: &str| {
        let mut config = config(Engine::Batch, &model, 1);
        change(&mut config);
        let error = SimEnvFactory::new(config).err().unwrap();
        assert!(matches!(error, EnvFactoryError::ActuatorNetwork { field, .. } if field == expected), "{error}");
    };
    check(|config| config.randomise.kp_scale = [0.9, 1.1], "randomise.kp_scale");
    check(|config| config.randomise.kd_scale = [0.9, 0.9], "randomise.kd_scale");
    check(
        |config| {
            config.server.model = None;
            remote::walk(config).reward.epistemic_uncertainty = 1.0;
        },
        "task.reward.epistemic_uncertainty",
    );
}

#[test]
fn play_and_evaluate_simulate_actuator_networks_and_identify_and_diagnose_reject_them() {
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
    let with_networks = play(&path("learned"), &["--model", model.to_str().unwrap()]);
    assert_ne!(with_networks.q("FL_calf"), play(&path("analytic"), &[]).q("FL_calf"));

    let (log, out) = (path("learned"), path("out"));
    for command in ["identify", "diagnose"] {
        let error = rejection(&[command, &log, "--out", &out], &model);
        assert!(error.contains("robot.toml: this command does not simulate actuator networks"), "{error}");
    }
    // The networks that moved the robot predict its motion, and the laws do not.
    let error_of = |more: &[&str]| {
        let output = twinstep(&[&["evaluate", "--json", &log], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap()["q_rmse_rad"].as_f64().unwrap()
    };
    let [networks, laws] = [error_of(&["--model", model.to_str().unwrap()]), error_of(&[])];
    assert!(networks < 0.5 * laws, "{networks} {laws} rad");
    // Gains that the networks do not know.
    let mut meta: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(path("learned/meta.json")).unwrap()).unwrap();
    meta["kp"] = 21.0.into();
    std::fs::write(path("learned/meta.json"), meta.to_string()).unwrap();
    let error = rejection(&["evaluate", &log], &model);
    assert!(error.contains("gains are not an input of this network"), "{error}");
}
