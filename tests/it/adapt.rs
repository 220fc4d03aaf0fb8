//! `twinstep adapt` on the robot of a server, through the real processes.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

/// Friction, and a delay that is no multiple of the period of the actuators.
const HIDDEN: &str = r#"robot = "go2"
[[effect]]
name = "viscous_friction"
scope = "all"
coefficient_nms = 0.4
[[effect]]
name = "command_delay"
scope = "all"
delay_s = 0.0135
"#;

fn twinstep(arguments: &[&str]) -> Output {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    Command::new(program).args(arguments).current_dir(root()).output().unwrap()
}

fn walk() -> String {
    root().join("data/policies/walk.safetensors").display().to_string()
}

/// Commands of a walk: the robot stands, then it walks.
const COMMANDS: &str = "start_s,end_s,vx,vy,wz\n0,6,0,0,0\n6,10,0.6,0.2,0.3\n10,14,-0.5,0,-0.8\n14,18,0.8,0,0\n";

/// Starts a server of the hidden robot. Returns it with two logs: of the robot that hangs, and that stands and walks.
fn hidden_robot(folder: &Path) -> (Process, String, [String; 2]) {
    let path = |name: &str| folder.join(name).display().to_string();
    let [model, commands, hanging, walking] = ["hidden.toml", "commands.csv", "hanging.parquet", "walking"].map(path);
    std::fs::write(&model, HIDDEN).unwrap();
    std::fs::write(&commands, COMMANDS).unwrap();
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "2", "--model", &model];
    let (server, endpoint) = Process::listening(&program, &serve.map(str::to_owned)).unwrap();
    let recorded = [
        twinstep(&["play", "data/go2_air_chirp", "--base", "fixed", "--model", &model, "--out", &hanging]),
        twinstep(&[
            "run",
            &walk(),
            "--endpoint",
            &endpoint,
            "--commands",
            &commands,
            "--fast",
            "--torque",
            "--log",
            &walking,
        ]),
    ];
    for output in recorded {
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    (server, endpoint, [hanging, walking])
}

/// The fine-tuning is too short to gain anything: what counts is that the policy that is kept is the better one.
#[test]
fn cause_is_named_and_the_policy_that_is_kept_is_the_better_one_on_the_robot() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, endpoint, [hanging, walking]) = hidden_robot(folder.path());
    let out = folder.path().join("adapted");
    let (policy, out_text) = (walk(), out.display().to_string());
    let short = ["--steps", "50000", "--robots", "3", "--runs", "1", "--seconds", "5", "--json"];
    let adapt = |more: &[&str]| {
        twinstep(
            &[&["adapt", &policy, &hanging, &walking, "--endpoint", &endpoint, "--out", &out_text][..], &short, more]
                .concat(),
        )
    };
    let first = adapt(&[]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let adapted: Value = serde_json::from_slice(&first.stdout).unwrap();
    for cause in ["viscous_friction@all", "command_delay@all"] {
        assert!(adapted["causes"].as_array().unwrap().contains(&cause.into()), "{adapted}");
    }
    let [before, after] = [0, 1].map(|policy| adapted["found"]["mean"][policy].as_f64().unwrap());
    let kept = std::fs::read(out.join("policy.safetensors")).unwrap();
    let expected = if adapted["is_adapted"] == true { out.join("tuned.safetensors") } else { policy.clone().into() };
    assert_eq!(kept, std::fs::read(expected).unwrap());
    let [fell_before, fell_after] = [0, 1].map(|policy| adapted["found"]["falls"][policy].as_u64().unwrap());
    if fell_before == fell_after {
        assert_eq!(adapted["is_adapted"] == true, after < before, "{adapted}");
    }
    // The server steps equal seeds to equal bits, and what is complete is not done again.
    let again = adapt(&[]);
    assert_eq!(serde_json::from_slice::<Value>(&again.stdout).unwrap(), adapted);
    assert!(!String::from_utf8_lossy(&again.stderr).contains("fine-tuning"));
    let other = adapt(&["--seed", "2"]);
    assert_eq!(other.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&other.stderr).contains("settings.txt differs"));
}

#[test]
fn robot_that_cannot_be_reached_and_a_task_without_an_error_are_named_before_a_training() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("adapted").display().to_string();
    let network = root().join("data/policies/walk.onnx").display().to_string();
    let cases = [
        (
            vec!["adapt", "data/policies/walk.safetensors", "data/go2_air_chirp", "--endpoint", "tcp/127.0.0.1:1"],
            "tcp/127.0.0.1:1",
        ),
        (vec!["adapt", "data/policies/walk.safetensors", "data/go2_air_chirp", "--seconds", "0"], "`--seconds` = 0"),
        (vec!["adapt", &network, "data/go2_air_chirp"], "walk.onnx"),
        (
            vec!["adapt", "data/policies/jump.safetensors", "data/go2_air_chirp", "--endpoint", "tcp/127.0.0.1:1"],
            "`--endpoint` is for policies of `walk`",
        ),
    ];
    for (arguments, named) in cases {
        let refused = twinstep(&[&arguments[..], &["--out", &out]].concat());
        let error = String::from_utf8_lossy(&refused.stderr);
        assert!(!refused.status.success() && error.contains(named), "{error}");
        assert!(!Path::new(&out).join("training").exists());
    }
}
