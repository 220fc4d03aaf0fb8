//! Configs in the form of each program; the expected values follow from their documentation and deployment code.

use std::path::PathBuf;

use super::*;
use crate::mapping::Mapping;

fn written(files: &[(&str, &str)]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, text) in files {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("created");
        std::fs::write(path, text).expect("written");
    }
    let path = folder.path().to_owned();
    (folder, path)
}

fn imported(files: &[(&str, &str)]) -> (ImportedPolicy, Mapping) {
    let (_folder, path) = written(files);
    let imported = import_policy(&[path]).unwrap_or_else(|error| panic!("{error}"));
    let mapping = Mapping::parse(&imported.mapping).unwrap_or_else(|error| panic!("{error}\n{}", imported.mapping));
    (imported, mapping)
}

fn gain(mapping: &Mapping, joint: &str) -> (f32, f32, f64) {
    let index = mapping.joints.iter().position(|name| name == joint).expect("a joint");
    (mapping.kp.of(index), mapping.kd.of(index), mapping.default_pose[joint])
}

/// Isaac Lab's joint order; gains in the order of the motors, where the right front leg is stiffer.
const DEPLOY: &str = "joint_ids_map: [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
step_dt: 0.02
stiffness: [30, 31, 32, 25, 25, 25, 25, 25, 25, 25, 25, 25]
damping: [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
default_joint_pos: [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5]
actions:
  JointPositionAction: {clip: null, joint_names: [.*], scale: [0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25]}
observations:
  base_ang_vel: {params: {}, clip: [-100, 100], scale: [0.2, 0.2, 0.2], history_length: 5}
  projected_gravity: {params: {}, clip: null, scale: [1.0, 1.0, 1.0], history_length: 5}
  gait_phase: {params: {period: 0.6}, clip: null, scale: [1.0, 1.0], history_length: 5}
";

#[test]
fn deploy_yaml_has_gains_in_the_order_of_the_motors() {
    let (imported, mapping) = imported(&[("params/deploy.yaml", DEPLOY)]);
    assert_eq!(gain(&mapping, "FR_hip"), (30.0, 0.5, -0.1));
    assert_eq!(gain(&mapping, "FR_thigh"), (31.0, 0.5, 0.8));
    assert_eq!(gain(&mapping, "FL_calf"), (25.0, 0.5, -1.5));
    assert_eq!(mapping.joints[..3], ["FL_hip", "FR_hip", "RL_hip"]);
    assert_eq!((mapping.policy_hz, mapping.input_len()), (50.0, 5 * (3 + 3 + 2)));
    let history = mapping.history.expect("a history");
    assert_eq!((history.layout, history.order), (crate::HistoryLayout::Terms, crate::HistoryOrder::OldestFirst));
    assert!(
        imported.origins.contains(&("kp".to_owned(), "deploy.yaml, stiffness, in the order of the motors".to_owned()))
    );
    assert_eq!((imported.missing, imported.disagreements), (vec![], vec![]));
    let gym = DEPLOY.replace("observations:\n", "observations:\n  use_gym_history: true\n");
    assert_eq!(
        self::imported(&[("deploy.yaml", &gym)]).1.history.expect("a history").layout,
        crate::HistoryLayout::Frames
    );
}

const ENV: &str = "sim: {dt: 0.005}
decimation: 4
scene:
  robot:
    init_state:
      joint_pos: {'.*L_hip_joint': 0.1, '.*R_hip_joint': -0.1, 'F[L,R]_thigh_joint': 0.8, 'R[L,R]_thigh_joint': 1.0, '.*_calf_joint': -1.5}
    actuators:
      legs: {joint_names_expr: ['.*_hip_joint', '.*_thigh_joint'], stiffness: 25.0, damping: 0.5}
      knees: {joint_names_expr: ['.*_calf_joint'], stiffness: {'F.*': 40.0, 'R.*': 45.0}, damping: 1.0}
actions:
  joint_pos:
    class_type: isaaclab.envs.mdp.actions.joint_actions:JointPositionAction
    joint_names: ['.*']
    scale: {'.*_hip_joint': 0.125, '^(?!.*_hip_joint).*': 0.25}
    use_default_offset: true
observations:
  policy:
    concatenate_terms: true
    history_length: null
    base_ang_vel: {func: 'isaaclab.envs.mdp.observations:base_ang_vel', scale: 0.2, clip: !!python/tuple [-100.0, 100.0], history_length: 0}
    actions: {func: 'isaaclab.envs.mdp.observations:last_action', scale: null, history_length: 3}
    joints: {func: 'isaaclab.envs.mdp.observations:joint_pos', scale: null}
  critic: {}
";

#[test]
fn env_yaml_is_resolved_by_its_expressions() {
    let (imported, mapping) =
        imported(&[("env.yaml", ENV), ("agent.yaml", "clip_actions: 5.0\nempirical_normalization: true\n")]);
    assert_eq!(gain(&mapping, "RR_hip"), (25.0, 0.5, -0.1));
    assert_eq!(gain(&mapping, "FL_calf"), (40.0, 1.0, -1.5));
    assert_eq!(gain(&mapping, "RL_calf"), (45.0, 1.0, -1.5));
    assert_eq!(gain(&mapping, "RL_thigh"), (25.0, 0.5, 1.0));
    assert_eq!((mapping.action_scale.of(0), mapping.action_scale.of(11)), (0.125, 0.25));
    assert_eq!(mapping.joints[4], "FL_thigh");
    assert_eq!(mapping.action_clip, Some([-5.0, 5.0]));
    assert_eq!(mapping.observation[2].term, crate::TermName::AbsoluteJointPosition);
    assert_eq!(mapping.input_len(), 3 + 3 * 12 + 12);
    assert!(imported.notes.iter().any(|note| note.contains("normaliser")), "{:?}", imported.notes);
    let indented = ENV.trim_end().replace('\n', "\n  ");
    let hydra = format!("env:\n  {indented}\nagent:\n  clip_actions: 5.0\n");
    assert_eq!(self::imported(&[(".hydra/config.yaml", &hydra)]).1, mapping, "the file that Hydra keeps");
}

const RL_SAR: &str = "go2/himloco:
  observations: [commands, ang_vel, gravity_vec, dof_pos, dof_vel, actions]
  observations_history: [0, 1, 2, 3, 4, 5]
  clip_actions_lower: [-100, -100]
  clip_actions_upper: [100, 100]
  rl_kp: [40, 41, 42, 40, 40, 40, 40, 40, 40, 40, 40, 40]
  rl_kd: [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
  action_scale: [0.125, 0.25, 0.25, 0.125, 0.25, 0.25, 0.125, 0.25, 0.25, 0.125, 0.25, 0.25]
  ang_vel_scale: 0.25
  dof_vel_scale: 0.05
  commands_scale: [2.0, 2.0, 0.25]
  default_dof_pos: [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
  joint_mapping: [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
";
const RL_SAR_BASE: &str = "go2:
  dt: 0.005
  decimation: 4
  joint_names: [FR_hip_joint, FR_thigh_joint, FR_calf_joint, FL_hip_joint, FL_thigh_joint, FL_calf_joint, RR_hip_joint, RR_thigh_joint, RR_calf_joint, RL_hip_joint, RL_thigh_joint, RL_calf_joint]
";

#[test]
fn rl_sar_has_its_joints_in_the_file_of_the_robot() {
    let (_, mapping) = imported(&[("go2/himloco/config.yaml", RL_SAR), ("go2/base.yaml", RL_SAR_BASE)]);
    assert_eq!(mapping.joints[..4], ["FL_hip", "FL_thigh", "FL_calf", "FR_hip"]);
    assert_eq!(gain(&mapping, "FL_thigh"), (41.0, 1.0, 0.8));
    let history = mapping.history.expect("a history");
    assert_eq!((history.length, history.order, mapping.policy_hz), (6, crate::HistoryOrder::NewestFirst, 50.0));
    assert_eq!(mapping.observation[0].scale, crate::Numbers::Each(vec![2.0, 2.0, 0.25]));
}

#[test]
fn what_is_missing_and_what_differs_is_named() {
    let text = DEPLOY
        .replace("stiffness:", "# stiffness:")
        .replace("  gait_phase: {params: {period: 0.6}", "  height_scan: {params: {}");
    let (_folder, path) = written(&[("deploy.yaml", &text), ("env.yaml", &ENV.replace("dt: 0.005", "dt: 0.01"))]);
    let imported = import_policy(&[path]).expect("sources");
    assert!(imported.missing.iter().any(|line| line.contains("`height_scan`")), "{:?}", imported.missing);
    assert!(
        imported.disagreements.iter().any(|line| line.starts_with("policy_hz: deploy.yaml")),
        "{:?}",
        imported.disagreements
    );
    // The gains come from the second source.
    assert!(imported.origins.contains(&("kp".to_owned(), "env.yaml, scene.robot.actuators.*.stiffness".to_owned())));
    let (_folder, path) = written(&[("config.yaml", "a: 1\n")]);
    let error = import_policy(&[path]).expect_err("no source").to_string();
    assert!(error.contains("no config of unitree_rl_lab"), "{error}");
}

#[test]
fn history_of_the_network_is_compared_with_that_of_the_config() {
    let network = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/elu_opset11.onnx");
    // Nine inputs and three outputs.
    let text = "joint_ids_map: [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]\nstep_dt: 0.02\nobservations:\n  base_ang_vel: {scale: 1.0, history_length: 1}\n";
    let (_folder, path) = written(&[("deploy.yaml", text)]);
    let imported = import_policy(&[path, network]).expect("sources");
    let differs = |start: &str| imported.disagreements.iter().any(|line| line.starts_with(start));
    assert!(differs("joints: the network's outputs have 3 numbers"), "{:?}", imported.disagreements);
    assert!(differs("history: the network reads 9 numbers"), "{:?}", imported.disagreements);
    assert!(imported.mapping.contains("[history]\nlength = 3"), "{}", imported.mapping);
}

const LEGGED_GYM: &str = "class GO2RoughCfg(LeggedRobotCfg):
    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {'hip_joint': 0.1, 'thigh_joint': 0.8, 'calf_joint': -1.5}
    class control(LeggedRobotCfg.control):
        stiffness = {'joint': 20.}
        damping = {'joint': 0.5}
        action_scale = 0.25
    class env(LeggedRobotCfg.env):
        num_observations = LEN
";

fn first_terms(len: usize) -> Vec<crate::TermName> {
    let (_, mapping) = imported(&[("go2_config.py", &LEGGED_GYM.replace("LEN", &len.to_string()))]);
    mapping.observation.iter().take(2).map(|term| term.term).collect()
}

#[test]
fn order_of_an_observation_that_no_config_contains_follows_from_its_length() {
    use crate::TermName::{BaseAngularVelocity, BaseLinearVelocity, ProjectedGravity, VelocityCommand};
    assert_eq!(first_terms(48), [BaseLinearVelocity, BaseAngularVelocity]);
    assert_eq!(first_terms(45), [BaseAngularVelocity, ProjectedGravity], "a robot does not measure its velocity");
    assert_eq!(first_terms(45 * 6), [VelocityCommand, BaseAngularVelocity], "HIMLoco keeps six steps");
}

const RL_GYM: &str = "joint2motor_idx: [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
kps: [21, 20, 20, 20, 20, 20, 20, 20, 20, 20, 20, 20]
kds: [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
default_angles: [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
control_dt: 0.02
obs_scales_ang_vel: 0.25
dof_vel_scale: 0.05
command_scale: [2.0, 2.0, 0.25]
action_scale: 0.25
num_obs: 47
";

#[test]
fn unitree_rl_gym_has_its_joints_in_the_order_of_the_motors() {
    let (imported, mapping) = imported(&[("go2.yaml", RL_GYM)]);
    assert_eq!(gain(&mapping, "FL_hip"), (21.0, 0.5, 0.1));
    assert_eq!(gain(&mapping, "RR_thigh"), (20.0, 0.5, 1.0));
    assert_eq!((mapping.policy_hz, mapping.input_len()), (50.0, 47));
    assert_eq!(mapping.observation[0].scale, crate::Numbers::Uniform(0.25));
    assert_eq!(mapping.observation[2].scale, crate::Numbers::Each(vec![2.0, 2.0, 0.25]));
    assert_eq!(mapping.observation[6].term, crate::TermName::GaitPhase);
    assert_eq!((imported.missing, imported.disagreements), (vec![], vec![]));
    let simulated = RL_GYM.replace("control_dt: 0.02", "simulation_dt: 0.002\ncontrol_decimation: 10");
    assert_eq!(self::imported(&[("go2.yaml", &simulated)]).1.policy_hz, 50.0);
}

#[test]
fn config_of_another_robot_is_recognised_by_its_pose() {
    // The legs of a G1: six joints each, and a knee where the Go2 has the hip of its right leg.
    let pose = "[-0.1, 0.0, 0.0, 0.3, -0.2, 0.0, -0.1, 0.0, 0.0, 0.3, -0.2, 0.0]";
    let humanoid = RL_GYM.replace("[0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]", pose);
    let (_folder, path) = written(&[("g1.yaml", &humanoid)]);
    let imported = import_policy(&[path]).expect("sources");
    let outside = |line: &String| line.starts_with("default_pose: FL_calf = 0 is outside the range of the Go2");
    assert!(imported.missing.iter().any(outside), "{:?}", imported.missing);
    assert!(Mapping::parse(&imported.mapping).is_err(), "no mapping of it runs");
}

#[test]
fn gains_of_all_joints_and_a_stack_of_observations_are_read() {
    let text = RL_GYM
        .replace("joint2motor", "leg_joint2motor")
        .replace("kps: [21, 20, 20, 20, 20, 20, 20, 20, 20, 20, 20, 20]", "stand_kp: 60\nctrl_kp: 22")
        .replace("num_obs: 47", "num_single_obs: 45\nframe_stack: 10");
    let (_, mapping) = imported(&[("ee.yaml", &text)]);
    assert_eq!((gain(&mapping, "RL_calf").0, mapping.input_len()), (22.0, 450));
    assert_eq!(mapping.history.expect("a history").order, crate::HistoryOrder::OldestFirst);
}

#[test]
fn networks_of_pytorch_come_with_the_line_that_converts_them() {
    let (_folder, path) = written(&[("motion.pt", "PK"), ("go2.yaml", RL_GYM)]);
    let error = import_policy(&[path.join("motion.pt")]).expect_err("PyTorch").to_string();
    assert!(error.contains("torch.onnx.export(torch.jit.load("), "{error}");
    let imported = import_policy(&[path]).expect("the config is enough");
    assert!(imported.notes.iter().any(|note| note.contains("torch.onnx.export(")), "{:?}", imported.notes);
}

#[test]
fn numbers_of_joints_without_names_are_not_called_missing() {
    let (_folder, path) = written(&[("config.yaml", RL_SAR)]);
    let imported = import_policy(&[path]).expect("sources");
    let line = "kp: config.yaml, rl_kp has numbers, but the order of the joints is not known; name them";
    assert!(imported.missing.contains(&line.to_owned()), "{:?}", imported.missing);
}
