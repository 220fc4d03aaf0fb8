//! `twinstep robot` in front of a fake robot, as processes on the robot's own wire.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_identify::{Experiment, WindowConfig};
use twinstep_model::{AutoresetMode, RealTimeReport, ResetRequest, VecEnv};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, python, root};
use twinstep_tests::robot_pair::{PATIENT, RobotPair, next_domain};

use crate::raw_client::RawClient;

pub fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

pub fn pair(robot: &[&str]) -> RobotPair {
    RobotPair::start(&program(), &[], robot).unwrap()
}

pub fn standing(robot: &[&str]) -> RobotPair {
    in_three_attempts(|| {
        let mut pair = RobotPair::start(&program(), &[], robot)?;
        pair.stand()?;
        Ok(pair)
    })
}

pub fn client(pair: &RobotPair) -> RemoteVecEnv {
    let options = ConnectOptions { autoreset: AutoresetMode::Disabled, ..ConnectOptions::new(&pair.endpoint, 1) };
    RemoteVecEnv::connect(&options).unwrap()
}

fn report(env: &RemoteVecEnv) -> RealTimeReport {
    env.real_time().unwrap().clone()
}

/// Time after which a client that does not end has lost its robot: it waits until the operator makes it stand again.
const LOST: Duration = Duration::from_secs(40);

/// Returns what the first successful of three attempts returns. A virtual machine that stands still for long makes the robot
/// stop, as it should.
fn in_three_attempts<T>(mut attempt: impl FnMut() -> Result<T, String>) -> T {
    let mut failures = Vec::new();
    for _ in 0..3 {
        match attempt() {
            Ok(value) => return value,
            Err(failure) => failures.push(failure),
        }
    }
    panic!("three attempts failed: {failures:#?}")
}

/// Runs a test that needs a computer which keeps time, up to three times.
pub fn test_in_real_time(test: impl Fn()) {
    let text = |panic: Box<dyn std::any::Any + Send>| match panic.downcast::<String>() {
        Ok(text) => *text,
        Err(other) => format!("{:?}", other.downcast_ref::<&str>()),
    };
    in_three_attempts(|| std::panic::catch_unwind(std::panic::AssertUnwindSafe(&test)).map_err(text));
}

/// Runs a policy file for some seconds as a user does, and returns its summary.
fn run_policy(pair: &mut RobotPair, seconds: &str) -> Result<Value, String> {
    let folder = tempfile::tempdir().unwrap();
    let (policy, summary) = (root().join("data/policies/walk.safetensors"), folder.path().join("summary.json"));
    let mut run = Command::new(program())
        .arg("run")
        .arg(policy)
        .args(["--endpoint", &pair.endpoint, "--velocity", "0.5,0,0", "--seconds", seconds, "--json"])
        .stdout(std::fs::File::create(&summary).unwrap())
        .spawn()
        .unwrap();
    ends_within(&mut run, LOST).map_err(|reason| format!("{reason}; robot: {}", pair.state()))?;
    Ok(serde_json::from_slice(&std::fs::read(&summary).unwrap()).unwrap())
}

/// Waits for the success of a program, and kills it if it takes too long.
fn ends_within(child: &mut std::process::Child, timeout: Duration) -> Result<(), String> {
    let since = Instant::now();
    while since.elapsed() < timeout {
        if let Some(status) = child.try_wait().unwrap() {
            return if status.success() { Ok(()) } else { Err(status.to_string()) };
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    Err(format!("it did not end within {timeout:?}"))
}

/// Returns how far the robot has walked along x [m].
fn place(pair: &mut RobotPair) -> f64 {
    pair.ask("pose").unwrap()["position"][0].as_f64().unwrap()
}

#[test]
fn trained_policy_walks_the_fake_robot_and_no_command_is_refused() {
    let (distance, summary, statistics) = in_three_attempts(|| {
        let mut pair = standing(&[]);
        let start = place(&mut pair);
        let summary = run_policy(&mut pair, "8")?;
        Ok((place(&mut pair) - start, summary, pair.ask("statistics").unwrap()))
    });
    assert_eq!(summary["falls"], 0);
    // 0.5 m/s for 8 s; the first step begins from rest.
    assert!((2.5..5.0).contains(&distance), "{distance} m");
    assert_eq!(statistics["refused"], 0, "{statistics}");
    assert!(statistics["accepted"].as_u64().unwrap() > 4000, "{statistics}");
}

#[test]
fn log_with_torques_of_the_fake_robot_follows_the_law_of_its_actuators() {
    let folder = tempfile::tempdir().unwrap();
    let log = in_three_attempts(|| {
        let pair = standing(&[]);
        let (policy, log) = (root().join("data/policies/walk.safetensors"), folder.path().join("log"));
        let _ = std::fs::remove_dir_all(&log);
        let mut run = Command::new(program())
            .arg("run")
            .arg(policy)
            .args(["--endpoint", &pair.endpoint, "--velocity", "0.5,0,0", "--seconds", "4", "--torque", "--log"])
            .arg(&log)
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        ends_within(&mut run, LOST)?;
        twinstep_logs::Log::open(&log).map_err(|error| error.to_string())
    });
    assert_eq!(log.meta().rate_hz, 200.0);
    // A busy machine misses ticks, and the log is that of the whole time.
    assert!((700..=1600).contains(&log.rows()), "{} rows of 200 steps", log.rows());
    let (mut error, mut torque) = (0.0, 0.0);
    for joint in log.joints() {
        let [q, dq, q_cmd, tau] =
            [log.q(joint), log.dq(joint), log.q_cmd(joint), log.tau_measured(joint)].map(Option::unwrap);
        for row in 0..log.rows() {
            // kp 30, kd 0.75; the ideal robot has no other law.
            let wanted = 30.0 * (q_cmd[row] - q[row]) - 0.75 * dq[row];
            error += (wanted - tau[row]).powi(2);
            torque += tau[row].powi(2);
        }
    }
    // The torque changes within the 5 ms whose mean is recorded.
    assert!((error / torque).sqrt() < 0.35, "{}", (error / torque).sqrt());
}

#[test]
fn nothing_is_sent_before_the_operator_arms_and_nothing_moves_before_he_makes_the_robot_stand() {
    let mut pair = pair(&[]);
    pair.wait_for("observe", Duration::from_mins(1)).unwrap();
    let refused = pair.operator("arm").unwrap();
    assert!(refused.contains("built-in controller"), "{refused}");
    assert!(pair.operator("stand").unwrap().starts_with("error"));
    let statistics = pair.ask("statistics").unwrap();
    assert_eq!((&statistics["accepted"], &statistics["refused"]), (&0.into(), &0.into()), "{statistics}");
}

#[test]
fn client_waits_until_the_operator_has_made_the_robot_stand() {
    test_in_real_time(|| {
        let mut pair = pair(&[]);
        let mut env = client(&pair);
        assert!(env.is_real_time());
        let waiting = std::thread::spawn(move || {
            let obs = env.reset(&ResetRequest::default()).unwrap().to_vec();
            (Instant::now(), obs.len())
        });
        std::thread::sleep(Duration::from_millis(500));
        assert!(!waiting.is_finished(), "the robot is not armed");
        pair.stand().unwrap();
        let stands = Instant::now();
        let (reset, obs_len) = waiting.join().unwrap();
        assert_eq!(obs_len, 45);
        assert!(reset + Duration::from_secs(1) > stands, "the reset came before the robot stood");
    });
}

#[test]
fn steps_follow_the_ticks_and_report_the_action_in_force() {
    test_in_real_time(|| {
        let pair = standing(&[]);
        let mut env = client(&pair);
        env.reset(&ResetRequest::default()).unwrap();
        env.step(&[0.0; 12]).unwrap();
        let (first, since) = (report(&env), Instant::now());
        for _ in 0..50 {
            let batch = env.step(&[0.1; 12]).unwrap();
            assert!(!batch.done(0), "{:?}", batch.real_time);
        }
        let (last, elapsed) = (report(&env), since.elapsed());
        let ticks = last.tick - first.tick;
        assert!((50..=55).contains(&ticks), "{ticks} ticks in 50 steps");
        assert!((elapsed.as_secs_f64() - 0.02 * ticks as f64).abs() < 0.1, "{elapsed:?}");
        let age = last.stamp_ns.abs_diff(last.tick * 20_000_000);
        assert!(age < 6_000_000, "the observation is {age} ns away from the beginning of its tick");
        assert!(last.applied.iter().all(|value| (value - 0.1).abs() < 1e-3), "{last:?}");
        assert_eq!(env.obs()[33..45], last.applied);
    });
}

#[test]
fn late_action_is_refused_and_a_silent_client_makes_the_robot_hold_then_sit() {
    test_in_real_time(|| {
        let mut pair = standing(&[]);
        let mut env = client(&pair);
        env.reset(&ResetRequest::default()).unwrap();
        for _ in 0..10 {
            env.step(&[0.0; 12]).unwrap();
        }
        std::thread::sleep(Duration::from_millis(50));
        env.step(&[0.5; 12]).unwrap();
        let late = report(&env);
        assert!(late.refused.as_ref().is_some_and(|reason| reason.contains("is for tick")), "{late:?}");
        assert!(late.late_ticks >= 2 && late.applied == [0.0; 12], "{late:?}");
        env.step(&[0.1; 12]).unwrap();
        assert_eq!(report(&env).refused, None);
        std::thread::sleep(Duration::from_millis(100));
        assert!(pair.state().starts_with("hold"), "{}", pair.state());
        pair.wait_for("sit", Duration::from_secs(2)).unwrap();
        let batch = env.step(&[0.5; 12]).unwrap();
        assert!(batch.truncated[0] && !batch.terminated[0]);
        let stop = report(&env).stop.unwrap();
        assert!(stop.reason.contains("actions in a row are missing"), "{stop:?}");
        pair.wait_for("fault", Duration::from_secs(5)).unwrap();
    });
}

#[test]
fn recording_of_a_killed_process_is_read_up_to_a_second_before_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut pair = pair(&["--record", path.to_str().unwrap()]);
    pair.wait_for("observe", Duration::from_mins(1)).unwrap();
    pair.operator("release").unwrap();
    pair.insist("arm").unwrap();
    let since = Instant::now();
    std::thread::sleep(Duration::from_millis(2700));
    pair.robot.kill();
    let recorded = since.elapsed().as_secs_f64();
    let log = twinstep_logs::Log::open(&path).unwrap();
    let seconds = log.rows() as f64 / 500.0;
    assert!(seconds > recorded - 1.2, "{seconds} s of {recorded} s");
    assert!(log.read_warnings()[0].contains("truncated"), "{:?}", log.read_warnings());
}

#[test]
fn robot_has_no_rollouts() {
    let pair = pair(&[]);
    let hello = RawClient::connect_to_only_server(&pair.endpoint, "stranger").hello();
    assert_eq!((hello.max_rollout_steps, hello.max_policy_bytes), (0, 0));
}

#[test]
fn hello_says_what_a_robot_cannot_measure_and_the_spec_is_that_of_the_simulator() {
    let pair = pair(&[]);
    let hello = RawClient::connect_to_only_server(&pair.endpoint, "stranger").hello();
    let real_time = hello.real_time.unwrap();
    assert!(real_time.absent_reward_terms.iter().any(|term| term == "track_linear_velocity"), "{real_time:?}");
    assert!(real_time.absent_reward_terms.iter().all(|term| !hello.spec.reward_terms.contains(term)));
    assert_eq!(real_time.absent_ends, ["min_base_height_m"]);
    assert_eq!((hello.max_envs, hello.spec.critic_observation.len()), (1, 0));
    let simulator = twinstep_envs::base_spec("walk", &twinstep_model::go2(), Vec::new(), 20.0);
    assert_eq!(hello.spec_hash, simulator.hash());
}

#[test]
fn recording_is_a_log_of_what_the_robot_did() {
    test_in_real_time(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        in_three_attempts(|| {
            let _ = std::fs::remove_file(&path);
            let mut pair = standing(&["--record", path.to_str().unwrap()]);
            let walked = run_policy(&mut pair, "2");
            pair.robot.interrupt().unwrap();
            assert_eq!(pair.robot.exit_code(Duration::from_secs(30)), Some(130));
            walked
        });
        let log = twinstep_logs::Log::open(&path).unwrap();
        assert_eq!(log.meta().rate_hz, 500.0);
        let steps = recorded_steps(&path);
        assert!((135..=150).contains(&steps.len()), "{} steps of 20 ms in 2 s, and 0.8 s to a stand", steps.len());
        let executed = steps.iter().filter(|step| step["refused"].is_null()).count();
        assert!(executed >= 90 && steps[50]["applied"].as_array().unwrap().len() == 12, "{executed}: {}", steps[50]);
        // Standing up takes 3 s.
        let seconds = log.rows() as f64 / 500.0;
        assert!((5.0..15.0).contains(&seconds), "{seconds} s");
        let (q, q_cmd) = (log.q("FL_thigh").unwrap(), log.q_cmd("FL_thigh").unwrap());
        let errors: Vec<f64> = q.iter().zip(q_cmd).map(|(q, wanted)| (q - wanted).abs()).collect();
        assert!(errors.iter().sum::<f64>() / (errors.len() as f64) < 0.5);
    });
}

/// Returns the messages on `/twinstep/step` of a recording.
fn recorded_steps(path: &Path) -> Vec<Value> {
    let bytes = std::fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let steps = messages.filter(|message| message.channel.topic == "/twinstep/step");
    steps.map(|message| serde_json::from_slice(&message.data).unwrap()).collect()
}

#[test]
fn endpoint_that_others_can_reach_needs_users_or_tls() {
    let output = Command::new(program())
        .args(["robot", "--interface", "127.0.0.1", "--domain", "209", "--listen", "tcp/0.0.0.0:0"])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("tcp/0.0.0.0:0") && text.contains("--zenoh"), "{text}");
    let output = Command::new(program()).args(["robot", "--interface", "eth77"]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && text.contains("eth77") && text.contains("lo"), "{text}");
}

/// Runs the example that walks with an exported policy, as a user of the Python client does.
fn walk_in_python(python: &Path, endpoint: &str) -> Result<String, String> {
    let client = root().join("clients/python");
    let mut example = Command::new(python)
        .arg(client.join("examples/walk.py"))
        .arg(root().join("data/policies/walk.onnx"))
        .args(["--endpoint", endpoint, "--seconds", "6"])
        .env("PYTHONPATH", client.join("src"))
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    ends_within(&mut example, LOST)?;
    Ok(String::from_utf8_lossy(&example.wait_with_output().unwrap().stdout).into_owned())
}

#[test]
fn same_python_script_walks_in_simulation_and_on_the_robot() {
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "1"];
    let (_server, endpoint) = Process::listening(&program(), &arguments.map(str::to_owned)).unwrap();
    let Some(python) = python(&crate::python::target()).unwrap() else { return };
    let text = walk_in_python(&python, &endpoint).unwrap();
    assert!(text.starts_with("0 falls"), "{text}");
    let (text, distance) = in_three_attempts(|| {
        let mut pair = standing(&[]);
        let start = place(&mut pair);
        let text = walk_in_python(&python, &pair.endpoint)?;
        Ok((text, place(&mut pair) - start))
    });
    assert!(text.starts_with("0 falls") && (1.8..4.0).contains(&distance), "{distance} m, {text}");
}

#[test]
fn policy_beside_the_control_loop_walks_with_the_sticks_and_without_a_client() {
    let policy = root().join("data/policies/walk.safetensors");
    let distance = in_three_attempts(|| {
        let mut pair = pair(&["--policy", policy.to_str().unwrap()]);
        pair.inject("remote stick 0 0.5 0").unwrap();
        pair.rise()?;
        pair.wait_for("run", Duration::from_secs(15))?;
        let start = place(&mut pair);
        std::thread::sleep(Duration::from_secs(6));
        let distance = place(&mut pair) - start;
        if pair.state().starts_with("run") { Ok(distance) } else { Err(pair.state().to_owned()) }
    });
    assert!((1.5..4.0).contains(&distance), "{distance} m");
}

/// Runs preflight on a fake robot with `mistake` and returns its report.
fn preflight(domain: &str, mistake: Option<&str>) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("robot.toml");
    std::fs::write(&config, PATIENT).unwrap();
    let fake = ["fake-robot", "--until-stdin-closes", "--released", "--domain", domain];
    let mut fake = Process::start(&program(), &fake.map(str::to_owned)).unwrap();
    assert!(fake.line(Duration::from_mins(1)).unwrap().starts_with("ready"));
    if let Some(mistake) = mistake {
        fake.write_line(mistake).unwrap();
        assert!(fake.line(Duration::from_secs(20)).unwrap().starts_with("ok"));
    }
    let mut child = Command::new(program())
        .args(["preflight", "--interface", "127.0.0.1", "--domain", domain, "--json", "--config"])
        .arg(&config)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), b"yes\n").unwrap();
    serde_json::from_slice(&child.wait_with_output().unwrap().stdout).unwrap()
}

#[test]
fn preflight_on_the_wire_finds_nothing_on_a_healthy_robot_and_names_a_mistake() {
    // A virtual machine that stands still for tens of milliseconds disturbs the motions, so there are three attempts.
    let is_healthy =
        |report: &Value| report["findings"].as_array().unwrap().is_empty() && report["stopped_by"] == Value::Null;
    let mut reports = (0..3).map(|_| preflight(&next_domain().to_string(), None));
    assert!(reports.any(|report| is_healthy(&report)), "findings on a healthy robot in each attempt");
    let report = preflight(&next_domain().to_string(), Some("mistake quaternion xyzw"));
    assert_eq!(report["findings"][0]["id"], "quaternion_xyzw", "{report}");
}

#[test]
fn preflight_sends_nothing_without_the_yes_of_the_operator() {
    let output = Command::new(program()).args(["preflight", "--fake"]).stdin(Stdio::null()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && text.contains("nothing was sent"), "{text}");
}

/// Walks a fake robot with a hidden effect by the client, and records what its messages say.
fn record_walk(model: &Path, velocity: &str, recording: &Path) {
    // A virtual machine that stands still for longer than the robot waits for its states ends a walk in a fault.
    let walks = (0..3).any(|_| {
        let _ = std::fs::remove_file(recording);
        walks_to_the_end(model, velocity, recording)
    });
    assert!(walks, "three walks in a row ended in a fault");
}

fn walks_to_the_end(model: &Path, velocity: &str, recording: &Path) -> bool {
    let (model, recording) = (model.to_str().unwrap(), recording.to_str().unwrap());
    let fake = ["--model", model, "--motion-capture", "--released"];
    let mut pair = RobotPair::start(&program(), &fake, &["--record", recording]).unwrap();
    if pair.stand().is_err() {
        return false;
    }
    let policy = root().join("data/policies/walk.safetensors");
    let policy = policy.to_str().unwrap();
    let arguments = ["run", policy, "--endpoint", &pair.endpoint, "--velocity", velocity, "--seconds", "6"];
    let mut run = Process::start(&program(), &arguments.map(str::to_owned)).unwrap();
    let code = run.exit_code(Duration::from_secs(20));
    pair.robot.interrupt().unwrap();
    assert_eq!(pair.robot.exit_code(Duration::from_secs(30)), Some(130));
    code == Some(0)
}

/// Median error of the joint positions that the simulator predicts for the 20 ms after a measured state [rad].
fn one_step_error(model: &Path, recording: &Path) -> f64 {
    let robot = twinstep_effects::ModelFile::load(model).unwrap().robot_model().unwrap();
    let log = twinstep_logs::Log::open(recording).unwrap();
    let step = WindowConfig { floating_length_s: 0.02, ..WindowConfig::EVALUATION };
    let experiment = Experiment::new(&log, &robot, step).unwrap();
    let mut simulator = BatchRollout::new(&robot, &SimConfig::default()).unwrap();
    let errors = experiment.position_errors(&mut simulator, &robot);
    let mut errors: Vec<f64> = errors.iter().flatten().map(|(_, error)| error.abs()).collect();
    errors.sort_by(f64::total_cmp);
    println!(
        "errors of one step: median {:.5}, 90 % {:.5} rad",
        errors[errors.len() / 2],
        errors[errors.len() * 9 / 10]
    );
    errors[errors.len() / 2]
}

#[test]
fn simulator_predicts_the_next_step_of_the_robot_within_the_noise_of_its_sensors() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("nominal.toml"), "robot = \"go2\"\n").unwrap();
    let other = "robot = \"go2\"\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"all\"\ntorque_nm = 1.0\n";
    std::fs::write(file("other.toml"), other).unwrap();
    record_walk(&file("nominal.toml"), "0.5,0,0", &file("walk.mcap"));
    let error = one_step_error(&file("nominal.toml"), &file("walk.mcap"));
    let error_of_other = one_step_error(&file("other.toml"), &file("walk.mcap"));
    // The median and not the mean square: where this computer stood still, commands arrived late. The noise of the encoders
    // is 0.0005 rad at the beginning and at the end, and 0.02 rad/s for up to 20 ms.
    assert!(error < 0.0008 && error_of_other > 1.3 * error, "{error} rad, with friction {error_of_other} rad");
}
