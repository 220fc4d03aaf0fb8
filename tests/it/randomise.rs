//! Domain randomisation from the intervals of a model file, in both engines and on the server.

use std::path::PathBuf;
use std::process::Command;

use tempfile::TempDir;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_envs::{OBS_LEN, TaskConfig};
use twinstep_model::{
    AutoresetMode, Command as RobotCommand, InitialState, ResetRequest, Restorable, RobotModel, Simulator, VecEnv, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;

use crate::remote;

/// Effects of actuator, joint, body, ground and sensor, with intervals.
const MEASURED: &str = "
[[effect]]
name = \"command_delay\"
scope = \"all\"
delay_s = 0.005
interval = { delay_s = [0.0, 0.02] }
[[effect]]
name = \"coulomb_friction\"
scope = \"calf\"
torque_nm = 0.5
interval = { torque_nm = [0.1, 0.9] }
[[effect]]
name = \"com_shift\"
scope = \"base\"
shift_m = [0.0, 0.0, 0.0]
interval = { shift_m = [[-0.03, -inf, -0.03], [0.03, inf, 0.03]] }
[[effect]]
name = \"ground_stiffness\"
scope = \"ground\"
time_constant_s = 0.01
interval = { time_constant_s = [0.004, 0.03] }
[[effect]]
name = \"gyro_bias\"
scope = \"base\"
bias_rad_s = [0.0, 0.0, 0.0]
interval = { bias_rad_s = [[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]] }
";

/// Writes a model file with [`MEASURED`], with or without its intervals.
fn model(name: &str, intervals: bool) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let lines = MEASURED.lines().filter(|line| intervals || !line.starts_with("interval"));
    std::fs::write(&path, format!("robot = \"go2\"\n{}", lines.collect::<Vec<_>>().join("\n"))).unwrap();
    (folder, path)
}

/// Returns a configuration in which robots differ only by the values sampled from the model file.
fn config(engine: Engine, model: &std::path::Path, effects: bool) -> Config {
    let mut config = remote::config(TaskConfig::default());
    config.sim.engine = engine;
    config.sim.threads = 1;
    config.server.model = Some(model.to_owned());
    remote::walk(&mut config).reset_joint_noise_rad = 0.0;
    remote::walk(&mut config).command.linear_velocity_x = [0.3, 0.3];
    remote::walk(&mut config).command.linear_velocity_y = [0.0, 0.0];
    remote::walk(&mut config).command.angular_velocity_z = [0.0, 0.0];
    config.randomise.effects = effects;
    config
}

/// Returns the observations of `env` after the reset and after each of ten steps.
fn episode(env: &mut dyn VecEnv, request: &ResetRequest) -> Vec<Vec<f32>> {
    let mut rows = vec![env.reset(request).unwrap().to_vec()];
    for step in 0..10 {
        let actions = vec![0.3 * (step as f32).sin(); 12 * env.num_envs()];
        rows.push(env.step(&actions).unwrap().obs.clone());
    }
    rows
}

fn local(config: &Config, envs: usize) -> Box<dyn VecEnv> {
    SimEnvFactory::new(config.clone()).unwrap().build(envs, AutoresetMode::NextStep, None).unwrap()
}

fn robot(rows: &[Vec<f32>], env: usize) -> Vec<&[f32]> {
    rows.iter().map(|row| &row[env * OBS_LEN..(env + 1) * OBS_LEN]).collect()
}

#[test]
fn effects_are_sampled_per_robot_and_episode_and_reproduced_by_seeds() {
    let (_folder, path) = model("measured.toml", true);
    for engine in [Engine::Rapier, Engine::Batch] {
        let run = |effects: bool, envs: usize, seed: u64| {
            let mut env = local(&config(engine, &path, effects), envs);
            let first = episode(&mut *env, &ResetRequest::seeded(seed, envs));
            (first, episode(&mut *env, &ResetRequest::default()))
        };
        let (nominal, _) = run(false, 2, 7);
        assert_eq!(robot(&nominal, 0), robot(&nominal, 1), "{engine:?}: without randomisation");
        let (first, second) = run(true, 2, 7);
        assert_ne!(robot(&first, 0), robot(&first, 1), "{engine:?}: two robots");
        assert_ne!(robot(&first, 0), robot(&second, 0), "{engine:?}: two episodes");
        assert_eq!(run(true, 2, 7), (first.clone(), second), "{engine:?}: the same seeds");
        let (alone, _) = run(true, 1, 8);
        assert_eq!(robot(&alone, 0), robot(&first, 1), "{engine:?}: row 1 equals the single environment with its seed");
    }
}

#[test]
fn randomisation_without_intervals_is_bitwise_identical_to_none() {
    let (_folder, path) = model("without_intervals.toml", false);
    for engine in [Engine::Rapier, Engine::Batch] {
        let [without, with] = [false, true].map(|effects| {
            let mut config = config(engine, &path, effects);
            // Other random quantities must not change either.
            remote::walk(&mut config).reset_joint_noise_rad = 0.1;
            config.randomise.mass_scale = [0.9, 1.1];
            episode(&mut *local(&config, 2), &ResetRequest::seeded(3, 2))
        });
        assert_eq!(with, without, "{engine:?}");
    }
}

#[test]
fn server_process_randomises_effects_by_configuration_or_by_flag() {
    let (folder, path) = model("measured.toml", true);
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    for (engine, flag) in [(Engine::Rapier, false), (Engine::Batch, true)] {
        let mut config = config(engine, &path, !flag);
        let file = folder.path().join("server.toml");
        std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();
        let mut arguments = vec!["serve".to_owned(), "--config".to_owned(), file.display().to_string()];
        arguments.extend(flag.then(|| "--randomise-effects".to_owned()));
        let (_server, endpoint) = Process::listening(&programs.twinstep(), &arguments).unwrap();
        let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
        config.randomise.effects = true;
        let request = ResetRequest::seeded(7, 2);
        let rows = episode(&mut env, &request);
        assert_ne!(robot(&rows, 0), robot(&rows, 1), "{engine:?}");
        assert_eq!(rows, episode(&mut *local(&config, 2), &request), "{engine:?}");
    }
}

#[test]
fn intervals_that_rarely_give_a_valid_robot_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("late.toml");
    let delay = |name: &str| {
        format!(
            "[[effect]]\nname = \"{name}\"\nscope = \"all\"\ndelay_s = 0.01\ninterval = {{ delay_s = [0.0, 0.06] }}\n"
        )
    };
    std::fs::write(&path, format!("robot = \"go2\"\n{}{}", delay("command_delay"), delay("command_delay"))).unwrap();
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--randomise-effects", "--model", path.to_str().unwrap()];
    let output = Command::new(programs.twinstep()).args(arguments).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(error.contains("`randomise.effects`") && error.contains("0.04 s"), "{error}");
}

/// Simulates one second of sway from the current state.
fn sway(backend: &mut impl Simulator) -> (Vec<[f32; 12]>, [f32; 3], [f32; 3]) {
    let pose = go2().control.default_pose_f32();
    let mut rows = Vec::new();
    for period in 0..200 {
        let target = pose.map(|q| q + 0.1 * (0.1 * period as f32).sin());
        backend.step(&[RobotCommand::hold(target, 30.0, 0.75)], &[true], 1).unwrap();
        rows.push(backend.measured().q[0]);
    }
    (rows, backend.states().truth.base_position[0], backend.measured().gyro[0])
}

fn check_reset_with_model<B: Restorable>(new_backend: impl Fn(RobotModel) -> B) {
    let sampled = twinstep_effects::parse_robot(&format!("robot = \"go2\"\n{MEASURED}"), "sampled").unwrap();
    let initial_state = InitialState::at_rest(0.34, go2().control.default_pose_f32());
    let mut reference = new_backend(sampled.clone());
    reference.reset(&[(0, initial_state)]).unwrap();
    let expected = sway(&mut reference);

    let mut backend = new_backend(go2());
    backend.reset_with_model(0, &sampled, &initial_state).unwrap();
    let start = backend.snapshot(0);
    assert!(sway(&mut backend) == expected, "the motion equals that of a backend built with this model");
    backend.reset(&[(0, initial_state)]).unwrap();
    assert!(sway(&mut backend) != expected, "a plain reset restores the nominal model");
    backend.restore(0, &start);
    assert!(sway(&mut backend) == expected, "a snapshot includes the model");
    assert!(backend.reset_with_model(1, &sampled, &initial_state).is_err(), "the backend has one robot");
}

#[test]
fn reset_with_model_changes_the_model_of_one_robot() {
    let sim = SimConfig { threads: 1, ..SimConfig::default() };
    check_reset_with_model(|robot| BatchBackend::new(robot, sim, 1).unwrap());
    check_reset_with_model(|robot| RapierBackend::new(robot, SimConfig { engine: Engine::Rapier, ..sim }, 1).unwrap());
}
