//! A policy of another program, imported from a config that does not contain the order of its observation.

use std::path::Path;
use std::process::Command;

use twinstep_agent::Mapping;
use twinstep_policy::Policy;
use twinstep_tests::foreign_policy::foreign_policy;
use twinstep_tests::python::{Programs, root};

/// The command first, then gravity: the order of no program that the importer knows.
const OBSERVATION: &str = "
[[observation]]
term = \"velocity_command\"
scale = [2.0, 2.0, 0.25]
[[observation]]
term = \"projected_gravity\"
[[observation]]
term = \"base_angular_velocity\"
scale = 0.25
[[observation]]
term = \"joint_position\"
[[observation]]
term = \"joint_velocity\"
scale = 0.05
[[observation]]
term = \"previous_action\"
";

const MAPPING: &str = "
joints = [\"FR_hip\", \"FR_thigh\", \"FR_calf\", \"FL_hip\", \"FL_thigh\", \"FL_calf\", \"RR_hip\", \"RR_thigh\", \"RR_calf\", \"RL_hip\", \"RL_thigh\", \"RL_calf\"]
action_scale = 0.25
kp = 30.0
kd = 0.75
policy_hz = 50.0
default_pose = { FR_hip = 0.0, FR_thigh = 0.9, FR_calf = -1.8, FL_hip = 0.0, FL_thigh = 0.9, FL_calf = -1.8, RR_hip = 0.0, RR_thigh = 0.9, RR_calf = -1.8, RL_hip = 0.0, RL_thigh = 0.9, RL_calf = -1.8 }
";

/// The same contract as unitree_rl_gym writes it, in the order of the motors.
const CONFIG: &str = "
joint2motor_idx: [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
kps: [30, 30, 30, 30, 30, 30, 30, 30, 30, 30, 30, 30]
kds: [0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75]
default_angles: [0.0, 0.9, -1.8, 0.0, 0.9, -1.8, 0.0, 0.9, -1.8, 0.0, 0.9, -1.8]
control_dt: 0.02
ang_vel_scale: 0.25
dof_vel_scale: 0.05
cmd_scale: [2.0, 2.0, 0.25]
action_scale: 0.25
num_obs: 45
";

fn import(folder: &Path) -> (String, Mapping) {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let _ = std::fs::remove_file(folder.join("mapping.toml"));
    let output = Command::new(program)
        .args(["import-policy", "policy.onnx", "go2.yaml", "--out", "mapping.toml"])
        .current_dir(folder)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    (said, Mapping::read(folder.join("mapping.toml")).unwrap())
}

#[test]
fn order_that_no_config_contains_is_that_with_which_the_robot_walks() {
    let folder = tempfile::tempdir().unwrap();
    let (walk, _) = Policy::read(root().join("data/policies/walk.safetensors")).unwrap();
    let mapping = Mapping::parse(&format!("{MAPPING}{OBSERVATION}")).unwrap();
    foreign_policy(&walk, &mapping).write_onnx(folder.path().join("policy.onnx")).unwrap();
    std::fs::write(folder.path().join("go2.yaml"), CONFIG).unwrap();
    let (said, imported) = import(folder.path());
    assert!(said.contains("taken instead: velocity_command, projected_gravity, base_angular_velocity"), "{said}");
    assert_eq!(imported.observation, mapping.observation);
    // A policy that cannot walk with any order: the mapping is that of the program, and it is said.
    let config = CONFIG.replace("action_scale: 0.25", "action_scale: 0.01");
    std::fs::write(folder.path().join("go2.yaml"), config).unwrap();
    let (said, _) = import(folder.path());
    assert!(said.contains("with none of 5 other orders"), "{said}");
}
