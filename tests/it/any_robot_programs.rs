//! Robots of any tree through the real programs: trained, and looked at.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

fn run(arguments: &[&str], folder: &Path) -> Output {
    let output = Command::new(program()).args(arguments).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

fn robot(name: &str) -> String {
    root().join("data/robots").join(name).display().to_string()
}

#[test]
fn arm_learns_to_follow_its_targets() {
    let folder = tempfile::tempdir().unwrap();
    let arm = robot("so101.toml");
    run(&["train", "pose", "--model", &arm, "--out", "arm", "--steps", "400000", "--envs", "256"], folder.path());
    let text = std::fs::read_to_string(folder.path().join("arm/evaluation.json")).unwrap();
    let evaluation: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((&evaluation["up"], evaluation["joints"].as_array().unwrap().len()), (&1.0.into(), 6), "{text}");
    // A robot that does not move has the error `target_rms`.
    let [rms, still] = ["rms", "target_rms"].map(|key| evaluation[key].as_f64().unwrap());
    assert!(rms < 0.7 * still, "{text}");
    assert!(folder.path().join("arm/policy.onnx").exists());
}

#[test]
fn joints_of_a_robot_file_and_of_a_log_move_on_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let scene = |target: &str, extra: &[&str]| {
        run(&[&["view", target, "--html", "page.html", "--seconds", "3"], extra].concat(), folder.path());
        let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
        std::fs::remove_file(folder.path().join("page.html")).unwrap();
        page
    };
    let page = scene(&robot("g1.xml"), &[]);
    assert!(page.contains("left_hip_pitch_joint") && page.contains("torque_limits"), "the joints of the G1");
    let mut rows = "t,q_shoulder_pan,q_cmd_shoulder_pan\n".to_owned();
    rows.extend((0..200).map(|row| {
        let t = 0.02 * f64::from(row);
        format!("{t},{},{}\n", 0.4 * t.sin(), 0.41 * t.sin())
    }));
    std::fs::write(folder.path().join("arm.csv"), rows).unwrap();
    let meta = r#"{"rate_hz": 50, "tau_sensor": "none", "segments": [{"name": "wave", "base": "fixed"}]}"#;
    std::fs::write(folder.path().join("arm.json"), meta).unwrap();
    let page = scene("arm.csv", &["--model", &robot("so101.toml")]);
    assert!(page.contains("shoulder_pan") && !page.contains("FL_hip"), "the joints of the arm");
    // Without its model the arm would be shown as a Go2 that does not move.
    let arguments = ["view", "arm.csv", "--html", "page.html"];
    let refused = Command::new(program()).args(arguments).current_dir(folder.path()).output().unwrap();
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(error.contains("shoulder_pan") && error.contains("--model"), "{error}");
}

#[test]
fn base_of_a_shipped_robot_is_fixed_if_it_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let text =
        |base: &str| String::from_utf8(run(&["mjcf", "--model", "g1", "--base", base], folder.path()).stdout).unwrap();
    assert!(text("floating").contains("<freejoint"));
    assert!(!text("fixed").contains("<freejoint"));
}

#[test]
fn server_shows_a_humanoid() {
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let model = robot("g1.toml");
    let arguments = ["serve", "--task", "pose", "--model", &model, "--listen", "tcp/127.0.0.1:0", "--view", &free];
    let _server = Process::listening(&program(), &arguments.map(str::to_owned)).unwrap();
    let mut stream = TcpStream::connect(free).unwrap();
    stream.write_all(b"GET /scene HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let body = answer.split("\r\n\r\n").nth(1).unwrap();
    let scene: serde_json::Value = serde_json::from_str(body).unwrap();
    assert_eq!(scene["joints"].as_array().unwrap().len(), 29, "{scene}");
    assert_eq!(scene["torque_limits"].as_array().unwrap().len(), 29);
    assert!(!scene["contacts"].as_array().unwrap().is_empty(), "the ground pushes at its feet");
}
