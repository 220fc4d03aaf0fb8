//! A policy of another program on the fake robot: the endpoint takes its contract from the operator, and refuses other policies.

use std::path::Path;
use std::process::{Command, Output};

use twinstep_agent::Mapping;
use twinstep_policy::Policy;
use twinstep_tests::foreign_policy::foreign_policy;
use twinstep_tests::process::Process;
use twinstep_tests::python::root;
use twinstep_tests::robot_pair::{PATIENT, RobotPair, next_domain};

use crate::robot::{program, standing, test_in_real_time};

/// Isaac Lab's order, other scales and another pose than those of the shipped policy, and softer hips.
const MAPPING: &str = "\
joints = [\"FL_hip\", \"FR_hip\", \"RL_hip\", \"RR_hip\", \"FL_thigh\", \"FR_thigh\", \"RL_thigh\", \"RR_thigh\", \"FL_calf\", \"FR_calf\", \"RL_calf\", \"RR_calf\"]
action_scale = [0.2, 0.2, 0.2, 0.2, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25]
kp = [28.0, 28.0, 28.0, 28.0, 30.0, 30.0, 30.0, 30.0, 30.0, 30.0, 30.0, 30.0]
kd = 0.75
policy_hz = 50.0
[default_pose]
FL_hip = 0.0
FR_hip = 0.0
RL_hip = 0.0
RR_hip = 0.0
FL_thigh = 0.9
FR_thigh = 0.9
RL_thigh = 0.9
RR_thigh = 0.9
FL_calf = -1.6
FR_calf = -1.6
RL_calf = -1.6
RR_calf = -1.6
[[observation]]
term = \"base_angular_velocity\"
scale = 0.25
[[observation]]
term = \"projected_gravity\"
[[observation]]
term = \"velocity_command\"
[[observation]]
term = \"joint_position\"
[[observation]]
term = \"joint_velocity\"
scale = 0.05
[[observation]]
term = \"previous_action\"
";

fn twinstep(arguments: &[&str]) -> Output {
    Command::new(program()).args(arguments).output().unwrap()
}

/// Writes the shipped policy as one of another program, with its mapping. Returns their paths.
fn written(folder: &Path) -> [String; 2] {
    let (walk, _) = Policy::read(root().join("data/policies/walk.safetensors")).unwrap();
    let paths = ["policy.onnx", "mapping.toml"].map(|name| folder.join(name));
    foreign_policy(&walk, &Mapping::parse(MAPPING).unwrap()).write_onnx(&paths[0]).unwrap();
    std::fs::write(&paths[1], MAPPING).unwrap();
    paths.map(|path| path.to_str().unwrap().to_owned())
}

#[test]
fn policy_of_another_program_walks_the_robot_whose_endpoint_has_its_contract() {
    let folder = tempfile::tempdir().unwrap();
    let [policy, mapping] = written(folder.path());
    test_in_real_time(|| {
        let mut pair = standing(&["--contract", &mapping]);
        let place = |pair: &mut RobotPair| pair.ask("pose").unwrap()["position"][0].as_f64().unwrap();
        let start = place(&mut pair);
        let run = |policy: &[&str]| {
            let options = ["--endpoint", &pair.endpoint, "--velocity", "0.5,0,0", "--seconds", "6"];
            twinstep(&[&["run"], policy, &options[..]].concat())
        };
        // The operator's contract holds: a policy with another one sends nothing.
        let shipped = root().join("data/policies/walk.safetensors");
        let refused = run(&[shipped.to_str().unwrap()]);
        let error = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2), "{error}");
        assert!(error.contains("joint_gains") && error.contains("--contract"), "{error}");
        let walked = run(&[&policy, "--mapping", &mapping]);
        let error = String::from_utf8_lossy(&walked.stderr).into_owned();
        assert!(walked.status.success(), "{error}");
        let distance = place(&mut pair) - start;
        assert!(distance > 1.5, "{distance} m");
        assert_eq!(pair.ask("statistics").unwrap()["refused"].as_u64().unwrap_or(0), 0);
    });
}

#[test]
fn contract_outside_the_safety_limits_does_not_start() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stiff.toml");
    std::fs::write(&path, "[control]\nkp = { hip = 30, thigh = 30, calf = 150 }\n").unwrap();
    let refused = twinstep(&["robot", "--fake", "--contract", path.to_str().unwrap()]);
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(error.contains("kp") && error.contains("150") && error.contains("calf"), "{error}");
    std::fs::write(&path, "[task]\nname = \"track\"\n").unwrap();
    let refused = twinstep(&["robot", "--fake", "--config", path.to_str().unwrap()]);
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(error.contains("\"track\" is not possible on a robot") && error.contains("observe_pose_error"), "{error}");
}

#[test]
fn path_is_followed_on_a_robot_without_motion_capture() {
    let task =
        "[task]\nname = \"track\"\npath = \"circle\"\nradius_m = 0.75\nspeed = 0.4\nobserve_pose_error = false\n";
    let policy = root().join("data/policies/track.safetensors");
    test_in_real_time(|| {
        let domain = next_domain().to_string();
        let fake = ["fake-robot", "--until-stdin-closes", "--domain", &domain].map(str::to_owned);
        let fake = Process::start(&program(), &fake).unwrap();
        let config = format!("{PATIENT}{task}");
        let domain = domain.parse().unwrap();
        let mut pair = RobotPair::in_front_of(fake, domain, &config, &program(), &[]).unwrap();
        pair.stand().unwrap();
        let start = pair.ask("pose").unwrap();
        // Half of the circle: from the right side to the left one.
        let seconds = std::f64::consts::PI * 0.75 / 0.4;
        let options = ["--endpoint", &pair.endpoint, "--seconds", &format!("{seconds:.2}")];
        let walked = twinstep(&[&["run", policy.to_str().unwrap()], &options[..]].concat());
        assert!(walked.status.success(), "{}", String::from_utf8_lossy(&walked.stderr));
        let end = pair.ask("pose").unwrap();
        let moved =
            [0, 1].map(|axis| end["position"][axis].as_f64().unwrap() - start["position"][axis].as_f64().unwrap());
        let distance = moved[0].hypot(moved[1]);
        // The diameter, within the drift of a robot that does not know where it is.
        assert!((0.9..2.1).contains(&distance), "{moved:?} m");
    });
}
