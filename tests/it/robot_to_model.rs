//! `examples/robot_to_model.sh`: from walks of a fake robot with a hidden effect to its diagnosis, and to a simulation of it.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use twinstep_tests::python::{Programs, root};

fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

/// Runs the script, and returns what it printed.
fn run_script(folder: &Path) -> Result<String, String> {
    let log = std::fs::File::create(folder.with_extension("log")).unwrap();
    let status = Command::new(root().join("examples/robot_to_model.sh"))
        .arg(folder)
        .current_dir(root())
        .env("TWINSTEP", program())
        .stdout(log.try_clone().unwrap())
        .stderr(log)
        .status()
        .unwrap();
    let text = std::fs::read_to_string(folder.with_extension("log")).unwrap();
    if status.success() { Ok(text) } else { Err(text) }
}

/// Returns the error of a model's left front calf on a recording [rad].
fn calf_error(model: &Path, recording: &Path) -> f64 {
    let output = Command::new(program()).args(["evaluate", "--json", "--model"]).arg(model).arg(recording).output();
    let report: Value = serde_json::from_slice(&output.unwrap().stdout).unwrap();
    report["per_joint"]["FL_calf"]["q_rmse_rad"].as_f64().unwrap()
}

/// The hidden Coulomb friction is 0.8 N·m at the left front calf.
#[test]
fn hidden_friction_is_named_and_the_model_with_it_has_the_smaller_error_on_another_walk() {
    let parent = tempfile::tempdir().unwrap();
    // A virtual machine that stands still for longer than the robot waits for its states ends a walk in a fault.
    let mut failures = Vec::new();
    let (folder, text) = (0..3)
        .find_map(|attempt| {
            let folder = parent.path().join(attempt.to_string());
            run_script(&folder).map(|text| (folder, text)).map_err(|text| failures.push(text)).ok()
        })
        .unwrap_or_else(|| panic!("{}", failures.join("\n")));
    let findings = std::fs::read_to_string(folder.join("diagnosis/findings.json")).unwrap();
    let diagnosis: Value = serde_json::from_str(&findings).unwrap();
    let found = diagnosis["findings"].as_array().unwrap();
    let friction = found.iter().find(|cause| cause["effect"] == "coulomb_friction" && cause["scope"] == "FL_calf");
    let friction = friction.unwrap_or_else(|| panic!("{text}\n{findings}"));
    let torque = friction["parameters"]["torque_nm"]["value"].as_f64().unwrap();
    assert!((0.6..1.0).contains(&torque), "{friction}");
    let second = folder.join("second.mcap");
    let [before, after] =
        ["nominal.toml", "diagnosis/extended.toml"].map(|model| calf_error(&folder.join(model), &second));
    assert!(after < 0.5 * before, "{before} -> {after} rad");
    assert!(text.contains(" 0 falls"), "the policy walks with the extended model: {text}");
}
