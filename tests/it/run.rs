//! `twinstep run` as a process, and policies with the conventions of other programs.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rand::RngExt;
use twinstep_agent::{BoundPolicy, LoadedPolicy, Mapping, OnnxNetwork, PolicyInput};
use twinstep_envs::{base_spec, privileged_fields};
use twinstep_logs::{Gain, Log, TorqueSensor};
use twinstep_model::{EnvSpec, go2, stream};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_tests::foreign_policy::foreign_policy;
use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, python, root, run as run_command};

const TYPES: &str = r#"
joints = ["FL_hip", "FR_hip", "RL_hip", "RR_hip", "FL_thigh", "FR_thigh", "RL_thigh", "RR_thigh", "FL_calf", "FR_calf", "RL_calf", "RR_calf"]
action_scale = 0.25
kp = 30.0
kd = 0.75
policy_hz = 50.0
[default_pose]
FL_hip = 0.1
FR_hip = -0.1
RL_hip = 0.1
RR_hip = -0.1
FL_thigh = 0.8
FR_thigh = 0.75
RL_thigh = 1.0
RR_thigh = 1.05
FL_calf = -1.5
FR_calf = -1.45
RL_calf = -1.5
RR_calf = -1.55
"#;
const TERMS: &str = r#"
[[observation]]
term = "velocity_command"
scale = [2.0, 2.0, 0.25]
[[observation]]
term = "base_angular_velocity"
scale = 0.25
[[observation]]
term = "projected_gravity"
scale = -1.0
[[observation]]
term = "joint_position"
[[observation]]
term = "joint_velocity"
scale = 0.05
clip = [-100.0, 100.0]
[[observation]]
term = "previous_action"
"#;

fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

fn serve(more: &[&str]) -> (Process, String) {
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "4"];
    let arguments: Vec<String> = arguments.iter().chain(more).map(ToString::to_string).collect();
    Process::listening(&program(), &arguments).unwrap()
}

fn policies() -> PathBuf {
    root().join("data/policies")
}

fn command(policy: &Path, endpoint: &str, more: &[&str]) -> Command {
    let mut command = Command::new(program());
    command.arg("run").arg(policy).args(["--endpoint", endpoint]).args(more);
    command
}

fn run(policy: &Path, endpoint: &str, more: &[&str]) -> Output {
    command(policy, endpoint, more).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn summary(output: &Output) -> serde_json::Value {
    assert!(output.status.success(), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn walk() -> Policy {
    Policy::read(policies().join("walk.safetensors")).unwrap().0
}

/// Returns the spec of a simulator.
fn simulator_spec() -> EnvSpec {
    EnvSpec { critic_observation: privileged_fields(), ..base_spec("walk", &go2(), Vec::new(), 20.0) }
}

/// Returns observations around those of a walking robot.
fn observations(count: usize) -> Vec<Vec<f32>> {
    let mut random = stream(5, "observations", 0);
    let ranges = [(3, 1.0), (3, 0.3), (3, 1.0), (12, 0.3), (12, 3.0), (12, 0.8)];
    let mut observation = || {
        let entries = ranges.iter().flat_map(|(len, range)| std::iter::repeat_n(*range, *len));
        let mut obs: Vec<f32> = entries.map(|range: f32| range * (2.0 * random.random::<f32>() - 1.0)).collect();
        obs[5] = -1.0;
        obs
    };
    (0..count).map(|_| observation()).collect()
}

fn original_action(policy: &Policy, obs: &[f32]) -> Vec<f32> {
    let mut action = vec![0.0; 12];
    PolicyRunner::new(policy).run(obs, &mut action);
    action
}

fn assert_near(one: &[f32], other: &[f32], tolerance: f32) {
    assert_eq!(one.len(), other.len());
    let largest = one.iter().zip(other).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
    assert!(largest <= tolerance, "the largest difference is {largest}");
}

#[test]
fn onnx_file_gives_the_actions_of_the_policy_file() {
    let network = OnnxNetwork::read(policies().join("walk.onnx")).unwrap();
    assert_eq!((network.inputs()[0].len(), network.outputs()[0].len()), (45, 12));
    let policy = walk();
    for obs in observations(200) {
        assert_near(&network.run(&[&obs]).unwrap()[0], &original_action(&policy, &obs), 1e-5);
    }
}

/// Exports a policy as rsl_rl has it, and one as HIMLoco has it, with both exporters of PyTorch.
const EXPORT_SCRIPT: &str = r#"
import json, sys, numpy, onnxruntime, torch
from torch import nn

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("mean", 0.1 * torch.randn(48))
        self.register_buffer("std", 0.5 + torch.rand(48))
        self.net = nn.Sequential(nn.Linear(48, 512), nn.ELU(), nn.Linear(512, 256), nn.ELU(), nn.Linear(256, 128),
                                 nn.ELU(), nn.Linear(128, 12))
    def forward(self, obs):
        return self.net((obs - self.mean) / (self.std + 1e-2))

class Estimator(nn.Module):
    def __init__(self):
        super().__init__()
        self.estimator = nn.Sequential(nn.Linear(270, 128), nn.ELU(), nn.Linear(128, 19))
        self.actor = nn.Sequential(nn.Linear(64, 128), nn.Tanh(), nn.Linear(128, 12))
    def forward(self, history):
        parts = self.estimator(history)
        latent = nn.functional.normalize(parts[..., 3:], dim=-1, p=2)
        return self.actor(torch.cat((history[:, :45], parts[..., :3], latent), dim=-1))

torch.manual_seed(0)
cases = []
for module, size in [(Policy(), 48), (Estimator(), 270)]:
    for dynamo in [False, True]:
        path = f"{sys.argv[1]}/policy_{size}_{int(dynamo)}.onnx"
        torch.onnx.export(module.eval(), (torch.zeros(1, size),), path, input_names=["obs"], output_names=["actions"],
                          dynamo=dynamo)
        obs = numpy.random.default_rng(1).uniform(-1, 1, (1, size)).astype(numpy.float32)
        action = onnxruntime.InferenceSession(path).run(None, {"obs": obs})[0]
        cases.append({"path": path, "obs": obs[0].tolist(), "action": action[0].tolist()})
json.dump(cases, open(f"{sys.argv[1]}/cases.json", "w"))
"#;

#[test]
fn exports_of_pytorch_give_the_actions_of_onnxruntime() {
    let target = Path::new(env!("CARGO_BIN_EXE_faults")).ancestors().nth(2).unwrap();
    let Some(python) = python(target).unwrap() else { return };
    let folder = tempfile::tempdir().unwrap();
    run_command(Command::new(python).args(["-c", EXPORT_SCRIPT]).arg(folder.path())).unwrap();
    let cases = std::fs::read_to_string(folder.path().join("cases.json")).unwrap();
    for case in serde_json::from_str::<Vec<serde_json::Value>>(&cases).unwrap() {
        let numbers = |key: &str| -> Vec<f32> { serde_json::from_value(case[key].clone()).unwrap() };
        let network = OnnxNetwork::read(case["path"].as_str().unwrap()).unwrap();
        assert_near(&network.run(&[&numbers("obs")]).unwrap()[0], &numbers("action"), 1e-5);
    }
}

/// Writes the shipped policy with the conventions of `mapping`, and reads it for the robot of the simulator.
fn bound(folder: &Path, mapping: &str) -> BoundPolicy {
    let (onnx, toml) = (folder.join("foreign.onnx"), folder.join("mapping.toml"));
    foreign_policy(&walk(), &Mapping::parse(mapping).unwrap()).write_onnx(&onnx).unwrap();
    std::fs::write(&toml, mapping).unwrap();
    LoadedPolicy::read(&onnx, Some(&toml)).unwrap().bind(&simulator_spec()).unwrap()
}

#[test]
fn policy_with_other_joints_scales_pose_and_history_gives_the_actions_of_the_original() {
    let policy = walk();
    let histories = [
        "",
        "[history]\nlength = 6\nlayout = \"frames\"\norder = \"newest_first\"\n",
        "[history]\nlength = 3\nlayout = \"frames\"\norder = \"oldest_first\"\n",
        "[history]\nlength = 5\nlayout = \"terms\"\norder = \"oldest_first\"\n",
    ];
    for history in histories {
        let folder = tempfile::tempdir().unwrap();
        let mut foreign = bound(folder.path(), &format!("{TYPES}{history}{TERMS}"));
        let mut last: Option<Vec<f32>> = None;
        for mut obs in observations(50) {
            // The previous action of the other policy is its own output, which is that of the original.
            match &last {
                Some(last) => obs[33..45].copy_from_slice(last),
                None => foreign_first_action(&mut obs),
            }
            let expected = original_action(&policy, &obs);
            let action = foreign.action(&PolicyInput { obs: &obs, critic_obs: &[] }).unwrap();
            assert_near(
                &action,
                &expected,
                1e-5 * (1.0 + expected.iter().fold(0.0, |max: f32, one| max.max(one.abs()))),
            );
            last = Some(action);
        }
    }
}

/// Sets the previous action that means an output of 0 of the other policy: its default pose.
fn foreign_first_action(obs: &mut [f32]) {
    let (spec, mapping) = (simulator_spec(), Mapping::parse(&format!("{TYPES}{TERMS}")).unwrap());
    for (joint, name) in spec.joint_order.iter().enumerate() {
        obs[33 + joint] = ((mapping.default_pose[name] - spec.default_pose[joint]) / spec.action_scale) as f32;
    }
}

#[test]
fn shipped_mappings_have_the_inputs_of_their_policies() {
    for (name, inputs) in [("isaaclab_go2_flat", 48), ("unitree_rl_lab_go2", 45), ("himloco_go2", 270)] {
        let mapping = Mapping::read(policies().join(format!("mappings/{name}.toml"))).unwrap();
        assert_eq!(mapping.input_len(), inputs, "{name}");
        let mut joints = mapping.joints.clone();
        joints.sort();
        let mut ours = simulator_spec().joint_order;
        ours.sort();
        assert_eq!(joints, ours, "{name}");
    }
}

#[test]
fn policies_that_do_not_fit_are_refused_with_every_difference() {
    let folder = tempfile::tempdir().unwrap();
    let (onnx, toml) = (folder.path().join("foreign.onnx"), folder.path().join("mapping.toml"));
    let other = format!("{TYPES}{TERMS}").replace("kp = 30.0", "kp = 25.0").replace("kd = 0.75", "kd = 0.5");
    foreign_policy(&walk(), &Mapping::parse(&other).unwrap()).write_onnx(&onnx).unwrap();
    let refusal = |mapping: &str, spec: &EnvSpec| {
        std::fs::write(&toml, mapping).unwrap();
        LoadedPolicy::read(&onnx, Some(&toml)).unwrap().bind(spec).unwrap_err().to_string()
    };
    expect_test::expect![[r#"
        policy and endpoint do not agree; no action was sent
          kp: the policy has 25, the endpoint 30
          kd: the policy has 0.5, the endpoint 0.75
          start the endpoint with the policy's contract: `--contract MAPPING`, for `twinstep serve` and for `twinstep robot`"#]]
    .assert_eq(&refusal(&other, &simulator_spec()));
    let with_velocity = format!("{TYPES}{}{TERMS}", "[[observation]]\nterm = \"base_linear_velocity\"\n");
    expect_test::expect![[r#"
        the network has 45 inputs; 48 are expected
          the mapping has base_linear_velocity 3, velocity_command 3, base_angular_velocity 3, projected_gravity 3, joint_position 12, joint_velocity 12, previous_action 12 for its input `obs`"#]]
    .assert_eq(&refusal(&with_velocity, &simulator_spec()));
    let in_place = format!("{TYPES}{TERMS}").replace("projected_gravity", "base_linear_velocity");
    let robot = EnvSpec { critic_observation: Vec::new(), ..simulator_spec() };
    expect_test::expect![[r#"
        the policy observes `base_linear_velocity`, which this endpoint does not give
          its observations are base_angular_velocity, projected_gravity, velocity_command, joint_position, joint_velocity, previous_action
          only simulators give it, in group `critic`; a robot does not measure it: train without it"#]]
    .assert_eq(&refusal(&in_place, &robot));
    let unmapped = LoadedPolicy::read(policies().join("walk.onnx"), None).unwrap();
    let mut stiff = go2();
    stiff.control.kp = [40.0; twinstep_model::NUM_JOINTS];
    let error = unmapped.bind(&base_spec("walk", &stiff, Vec::new(), 20.0)).unwrap_err().to_string();
    assert!(error.contains("kp: the policy has 30, the endpoint 40"), "{error}");
}

/// Appends an input of the graph to an ONNX file. Protocol Buffers merge a message with one that follows.
fn with_input(onnx: &[u8], name: &str, shape: &[u8]) -> Vec<u8> {
    let field = |number: u8, content: &[u8]| [&[number << 3 | 2, content.len() as u8], content].concat();
    let dimensions: Vec<u8> = shape.iter().flat_map(|len| field(1, &[1 << 3, *len])).collect();
    let tensor = [&[1 << 3, 1][..], &field(2, &dimensions)].concat();
    let input = [field(1, name.as_bytes()), field(2, &field(1, &tensor))].concat();
    [onnx, &field(7, &field(11, &input))].concat()
}

#[test]
fn onnx_files_with_other_inputs_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recurrent.onnx");
    let bytes = std::fs::read(policies().join("walk.onnx")).unwrap();
    std::fs::write(&path, with_input(&bytes, "h_in", &[1, 1, 64])).unwrap();
    let error = LoadedPolicy::read(&path, None).unwrap().bind(&simulator_spec()).unwrap_err().to_string();
    expect_test::expect![[r#"
        the network has 109 inputs; 45 are expected
          the `spec` in its metadata does not belong to it"#]]
    .assert_eq(&error);
    std::fs::write(&path, b"nothing").unwrap();
    let error = OnnxNetwork::read(&path).unwrap_err().to_string();
    assert!(error.contains("it is"), "{error}");
}

#[test]
fn policy_follows_the_given_velocity_and_its_log_is_what_happened() {
    let folder = tempfile::tempdir().unwrap();
    let log_folder = folder.path().join("log");
    let (_server, endpoint) = serve(&[]);
    let log_argument = ["--log", log_folder.to_str().unwrap()];
    let arguments = ["--velocity", "0.5,0,-0.3", "--seconds", "6", "--fast", "--json"];
    let output = run(&policies().join("walk.safetensors"), &endpoint, &[&arguments[..], &log_argument].concat());
    let summary = summary(&output);
    assert_eq!((summary["steps"].as_u64(), summary["falls"].as_u64()), (Some(300), Some(0)), "{summary}");
    let mean = |key: &str, entry: usize| summary[key][entry].as_f64().unwrap();
    assert!((mean("mean_command", 2) + 0.3).abs() < 1e-6 && (mean("mean_command", 0) - 0.5).abs() < 1e-6);
    // The first of the six seconds is the acceleration.
    assert!((mean("mean_velocity", 0) - 0.5).abs() < 0.15, "{summary}");
    assert!((mean("mean_velocity", 2) + 0.3).abs() < 0.15, "{summary}");

    let log = Log::open(&log_folder).unwrap();
    let meta = log.meta();
    assert_eq!((log.rows(), meta.rate_hz, meta.tau_sensor), (300, 50.0, TorqueSensor::None));
    assert_eq!((&meta.kp, &meta.kd), (&Some(Gain::Uniform(30.0)), &Some(Gain::Uniform(0.75))));
    assert!(log.ignored().is_empty() && log.tau_measured("FL_hip").is_none());
    for name in ["dq_RR_calf", "gyro_z", "quat_w", "pos_x", "vel_x", "q_cmd_FL_hip"] {
        assert!(log.channel(name).unwrap().iter().all(|cell| cell.is_finite()), "{name}");
    }
    let x = log.channel("pos_x").unwrap();
    assert!((x[299] - x[0]).hypot(log.channel("pos_y").unwrap()[299]) > 1.5, "the robot has walked");
    let (q, q_cmd) = (log.q("FL_thigh").unwrap(), log.q_cmd("FL_thigh").unwrap());
    let difference = q.iter().zip(q_cmd).map(|(q, q_cmd)| (q - q_cmd).abs()).fold(0.0, f64::max);
    assert!(difference > 0.01 && difference < 1.0, "{difference}");

    let again = run(&policies().join("walk.safetensors"), &endpoint, &[&arguments[..], &log_argument].concat());
    assert_eq!(again.status.code(), Some(2), "a log is not overwritten");
    assert!(text(&again.stderr).contains("is not empty"), "{}", text(&again.stderr));
    let evaluated = Command::new(program()).arg("evaluate").arg(&log_folder).arg("--json").output().unwrap();
    let evaluation: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rmse = evaluation["q_rmse_rad"].as_f64().unwrap();
    assert!(rmse < 0.02, "the model of the evaluation is that of the server: {rmse}");
}

#[test]
fn foreign_policy_walks_as_the_original() {
    let folder = tempfile::tempdir().unwrap();
    let (onnx, toml) = (folder.path().join("foreign.onnx"), folder.path().join("mapping.toml"));
    let history = "[history]\nlength = 4\nlayout = \"terms\"\norder = \"oldest_first\"\n";
    // The environment clips previous actions to 1, half a radian.
    let nominal = go2().control.default_pose;
    let mapping = Mapping::parse(&format!("{TYPES}{history}{TERMS}")).unwrap();
    let mut lines: Vec<String> =
        format!("{TYPES}{history}{TERMS}clip = [-2.0, 2.0]\n").lines().map(str::to_owned).collect();
    for line in &mut lines {
        if let Some(joint) = mapping.joints.iter().find(|joint| line.starts_with(&format!("{joint} = "))) {
            let index = simulator_spec().joint_order.iter().position(|name| name == joint).unwrap();
            *line = format!("{joint} = {:?}", nominal[index]);
        }
    }
    let text = lines.join("\n");
    foreign_policy(&walk(), &Mapping::parse(&text).unwrap()).write_onnx(&onnx).unwrap();
    std::fs::write(&toml, &text).unwrap();
    let (_server, endpoint) = serve(&[]);
    let log_of = |policy: &Path, name: &str, more: &[&str]| {
        let path = folder.path().join(name);
        let arguments =
            ["--velocity", "0.6,0,0", "--seconds", "5", "--fast", "--json", "--log", path.to_str().unwrap()];
        let summary = summary(&run(policy, &endpoint, &[&arguments, more].concat()));
        assert_eq!(summary["falls"], 0, "{summary}");
        (Log::open(&path).unwrap(), summary)
    };
    let (original, first) = log_of(&policies().join("walk.onnx"), "original", &[]);
    let (foreign, second) = log_of(&onnx, "foreign", &["--mapping", toml.to_str().unwrap()]);
    for joint in original.joints() {
        // Rounding errors grow with time.
        for row in 0..25 {
            let difference = original.q_cmd(joint).unwrap()[row] - foreign.q_cmd(joint).unwrap()[row];
            assert!(difference.abs() < 1e-4, "{joint}, row {row}: {difference}");
        }
    }
    let forward = |summary: &serde_json::Value| summary["mean_velocity"][0].as_f64().unwrap();
    assert!((forward(&first) - forward(&second)).abs() < 0.02, "{first} {second}");
}

#[test]
fn nothing_is_recorded_if_policy_and_endpoint_do_not_agree() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model.toml");
    std::fs::write(&model, "robot = \"go2\"\n[control]\nkp = 25.0\n").unwrap();
    let (_server, endpoint) = serve(&["--model", model.to_str().unwrap()]);
    let log = folder.path().join("log");
    let output = run(&policies().join("walk.onnx"), &endpoint, &["--log", log.to_str().unwrap(), "--seconds", "1"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("kp: the policy has 30, the endpoint 25"), "{}", text(&output.stderr));
    assert!(!log.exists());
}

#[test]
fn velocity_is_refused_by_a_task_without_one_and_beyond_its_bounds() {
    let policy = policies().join("walk.safetensors");
    let (_counter, endpoint) = serve(&["--task", "counter"]);
    let output = run(&policy, &endpoint, &["--velocity", "0.5,0,0", "--seconds", "1"]);
    assert!(text(&output.stderr).contains("the task `counter` has no velocity command"), "{}", text(&output.stderr));
    assert_eq!(output.status.code(), Some(1));
    let (_walk, endpoint) = serve(&[]);
    for (velocity, part) in
        [("0,7,0", "velocity_command[1] is 7; -5 to 5 is allowed"), ("0,0,nan", "is NaN"), ("1,2", "three numbers")]
    {
        let output = run(&policy, &endpoint, &["--velocity", velocity, "--seconds", "1"]);
        assert_eq!(output.status.code(), Some(2));
        assert!(text(&output.stderr).contains(part), "{}", text(&output.stderr));
    }
}

/// Starts a run in real time with a log, and waits until the log has rows.
fn start_logging(endpoint: &str, log: &Path, more: &[&str]) -> std::process::Child {
    let arguments = [&["--velocity", "0.3,0,0", "--json", "--log", log.to_str().unwrap()], more].concat();
    let child = command(&policies().join("walk.safetensors"), endpoint, &arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let since = Instant::now();
    while std::fs::metadata(log.join("data.csv")).map_or(0, |file| file.len()) < 20_000 {
        assert!(since.elapsed() < Duration::from_mins(2), "the log has no rows");
        std::thread::sleep(Duration::from_millis(20));
    }
    child
}

fn signal(name: &str, process: u32) {
    assert!(Command::new("kill").args([&format!("-{name}"), &process.to_string()]).status().unwrap().success());
}

#[test]
fn interrupt_ends_a_run_without_a_time_and_kill_leaves_a_valid_log() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, endpoint) = serve(&[]);
    let log = folder.path().join("interrupted");
    let child = start_logging(&endpoint, &log, &[]);
    signal("INT", child.id());
    let output = child.wait_with_output().unwrap();
    let rows = summary(&output)["log_rows"].as_u64().unwrap();
    assert_eq!(Log::open(&log).unwrap().rows() as u64, rows);

    let log = folder.path().join("early");
    let child = start_logging(&endpoint, &log, &["--seconds", "100"]);
    signal("INT", child.id());
    let output = child.wait_with_output().unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(130), 0), "100 s are not over");

    let log = folder.path().join("killed");
    let mut child = start_logging(&endpoint, &log, &[]);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(Log::open(&log).unwrap().rows() > 10);
}

#[test]
fn lost_server_ends_the_run_with_its_log() {
    let folder = tempfile::tempdir().unwrap();
    let (mut server, endpoint) = serve(&[]);
    let log = folder.path().join("log");
    let child = start_logging(&endpoint, &log, &[]);
    signal("TERM", server.id());
    let output = child.wait_with_output().unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(1), 0));
    assert!(text(&output.stderr).contains("shutting down"), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains(" rows in "), "{}", text(&output.stderr));
    assert!(Log::open(&log).unwrap().rows() > 10);
    server.kill();
}

#[test]
fn steps_follow_real_time() {
    let (_server, endpoint) = serve(&[]);
    let since = Instant::now();
    let output = run(&policies().join("walk.safetensors"), &endpoint, &["--seconds", "2", "--json"]);
    let summary = summary(&output);
    assert!(since.elapsed() >= Duration::from_millis(1950), "{:?}", since.elapsed());
    assert_eq!(summary["steps"], 100);
    // Without a velocity of the agent the task has its own.
    assert!(summary["mean_command"].is_array(), "{summary}");
}

#[test]
fn sticks_of_a_gamepad_are_the_velocity_command() {
    let folder = tempfile::tempdir().unwrap();
    let device = folder.path().join("js0");
    assert!(Command::new("mkfifo").arg(&device).status().unwrap().success());
    let (_server, endpoint) = serve(&[]);
    let arguments = ["--gamepad", device.to_str().unwrap(), "--seconds", "4", "--json"];
    let child = command(&policies().join("walk.safetensors"), &endpoint, &arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut sticks = std::fs::OpenOptions::new().write(true).open(&device).unwrap();
    let [low, high] = (-32767i16).to_le_bytes();
    std::io::Write::write_all(&mut sticks, &[0, 0, 0, 0, low, high, 2, 1]).unwrap();
    let summary = summary(&child.wait_with_output().unwrap());
    let forward = summary["mean_command"][0].as_f64().unwrap();
    assert!(forward > 0.9, "the stick is forward: {summary}");
    let missing = run(&policies().join("walk.safetensors"), &endpoint, &["--gamepad", "/dev/input/none"]);
    assert_eq!(missing.status.code(), Some(2));
}

#[test]
fn keys_are_the_velocity_command_and_the_terminal_is_restored() {
    // A terminal for the program; part of util-linux.
    if Command::new("script").arg("--version").output().is_err() {
        eprintln!("skipped: there is no program `script`");
        return;
    }
    let (_server, endpoint) = serve(&[]);
    let run = format!(
        "{} run {} --endpoint {endpoint} --keyboard --seconds 2 --json 2>/dev/null",
        program().display(),
        policies().join("walk.safetensors").display()
    );
    let mut child = Command::new("script")
        .args(["-qec", &format!("stty -g; {run}; stty -g"), "/dev/null"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut keys = child.stdin.take().unwrap();
    std::io::Write::write_all(&mut keys, b"www").unwrap();
    let output = text(&child.wait_with_output().unwrap().stdout);
    let modes: Vec<&str> =
        output.split_whitespace().filter(|word| word.matches(':').count() > 20 && !word.starts_with('{')).collect();
    assert!(modes.len() == 2 && modes[1].ends_with(&modes[0][4..]), "{output}");
    let json = &output[output.find("{\"policy\"").unwrap()..=output.rfind('}').unwrap()];
    let summary: serde_json::Value = serde_json::from_str(json).unwrap();
    let forward = summary["mean_command"][0].as_f64().unwrap();
    assert!(forward > 0.15 && forward < 0.31, "{summary}");
}
