//! `twinstep adapt` on the robot of a server, through the real processes.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

const HIDDEN: &str =
    "robot = \"go2\"\n[[effect]]\nname = \"viscous_friction\"\nscope = \"all\"\ncoefficient_nms = 0.4\n";

fn twinstep(arguments: &[&str]) -> Output {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    Command::new(program).args(arguments).current_dir(root()).output().unwrap()
}

fn walk() -> String {
    root().join("data/policies/walk.safetensors").display().to_string()
}

/// Starts a server of the hidden robot, and records a walk of it.
fn hidden_robot(folder: &Path) -> (Process, String, String) {
    let model = folder.join("hidden.toml");
    std::fs::write(&model, HIDDEN).unwrap();
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "2", "--model", &model.display().to_string()];
    let (server, endpoint) = Process::listening(&program, &serve.map(str::to_owned)).unwrap();
    let log = folder.join("log").display().to_string();
    let recorded =
        twinstep(&["run", &walk(), "--endpoint", &endpoint, "--seconds", "20", "--fast", "--torque", "--log", &log]);
    assert!(recorded.status.success(), "{}", String::from_utf8_lossy(&recorded.stderr));
    (server, endpoint, log)
}

/// The fine-tuning is too short to gain anything: what counts is that the policy that is kept is the better one.
#[test]
fn cause_is_named_and_the_policy_that_is_kept_is_the_better_one_on_the_robot() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, endpoint, log) = hidden_robot(folder.path());
    let out = folder.path().join("adapted");
    let (policy, out_text) = (walk(), out.display().to_string());
    let short = ["--steps", "50000", "--robots", "3", "--runs", "1", "--seconds", "5", "--json"];
    let adapt = |more: &[&str]| {
        twinstep(&[&["adapt", &policy, &log, "--endpoint", &endpoint, "--out", &out_text][..], &short, more].concat())
    };
    let first = adapt(&[]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let adapted: Value = serde_json::from_slice(&first.stdout).unwrap();
    assert!(adapted["causes"].as_array().unwrap().contains(&"viscous_friction@all".into()), "{adapted}");
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
    let explore = root().join("data/policies/walk.onnx").display().to_string();
    let cases = [
        (
            vec!["adapt", "data/policies/walk.safetensors", "data/go2_air_chirp", "--endpoint", "tcp/127.0.0.1:1"],
            "tcp/127.0.0.1:1",
        ),
        (vec!["adapt", "data/policies/walk.safetensors", "data/go2_air_chirp", "--seconds", "0"], "`--seconds` = 0"),
        (vec!["adapt", &explore, "data/go2_air_chirp"], "walk.onnx"),
    ];
    for (arguments, named) in cases {
        let refused = twinstep(&[&arguments[..], &["--out", &out]].concat());
        let error = String::from_utf8_lossy(&refused.stderr);
        assert!(!refused.status.success() && error.contains(named), "{error}");
        assert!(!Path::new(&out).join("training").exists());
    }
}
