//! Policies and what the robot sends: examples, and reading as `twinstep run` and `twinstep robot` do.

use std::path::Path;

use twinstep_agent::{Mapping, OnnxNetwork, import_policy};
use twinstep_envs::base_spec;
use twinstep_model::go2;
use twinstep_policy::{Mlp, Normaliser, Policy, PolicyOrigin, PolicyRunner};
use twinstep_robot::Reading;
use twinstep_unitree::{ImuState, LowState, MotorState, RpcResponse, decode, encode};

use super::format::{Format, Outcome, examples_in};

/// Number of units of the network.
const HIDDEN: usize = 2;

/// Returns the examples of a format of this file.
pub fn examples(format: Format) -> Vec<Vec<u8>> {
    match format {
        Format::Policy => vec![written("policy.safetensors")],
        Format::Onnx => [vec![written("policy.onnx")], examples_in("crates/agent/golden", "", "_script.onnx")].concat(),
        Format::Mapping => examples_in("data/policies/mappings", "", ".toml"),
        Format::PolicyConfig => [DEPLOY_YAML, ENV_YAML, RL_SAR_YAML].map(|text| text.as_bytes().to_vec()).to_vec(),
        Format::PolicyConfigPy => vec![LEGGED_GYM.into()],
        Format::LowState => vec![encode(&upright().with_checksum())],
        _ => vec![encode(&RpcResponse { id: 7, api_id: 1001, data: SERVICE.to_owned(), ..RpcResponse::default() })],
    }
}

/// Answer of the service that says which controller is active.
const SERVICE: &str = r#"{"form":"0","name":"mcf"}"#;

/// Configs in the form of each program.
const DEPLOY_YAML: &str = "joint_ids_map: [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
step_dt: 0.02
stiffness: [30, 31, 32, 25, 25, 25, 25, 25, 25, 25, 25, 25]
damping: [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
default_joint_pos: [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5]
actions: {JointPositionAction: {clip: null, scale: 0.25}}
observations:
  base_ang_vel: {params: {}, clip: [-100, 100], scale: [0.2, 0.2, 0.2], history_length: 5}
  gait_phase: {params: {period: 0.6}, clip: null, scale: [1.0, 1.0], history_length: 5}
";
const ENV_YAML: &str = "sim: {dt: 0.005}
decimation: 4
scene:
  robot:
    init_state:
      joint_pos: &pose {'.*L_hip_joint': 0.1, '.*R_hip_joint': -0.1, '.*_thigh_joint': 0.8, '.*_calf_joint': -1.5}
    actuators:
      legs: {joint_names_expr: ['.*'], stiffness: {'.*_hip_.*': 25.0, '^(?!.*_hip_joint).*': 40.0}, damping: 0.5}
actions:
  joint_pos: {class_type: 'x:JointPositionAction', joint_names: ['.*'], scale: 0.25}
observations:
  policy:
    history_length: 2
    base_ang_vel: {func: 'mdp:base_ang_vel', scale: 0.2, clip: !!python/tuple [-100.0, 100.0], history_length: 0}
    actions: {func: 'mdp:last_action', scale: null, history_length: 3}
reset: *pose
";
const RL_SAR_YAML: &str = "go2/himloco:
  observations: [commands, ang_vel, dof_pos, actions]
  observations_history: [0, 1, 2]
  clip_actions_lower: [-100, -100]
  clip_actions_upper: [100, 100]
  rl_kp: [40, 41, 42]
  rl_kd: [1, 1, 1]
  action_scale: [0.125, 0.25, 0.25]
  commands_scale: [2.0, 2.0, 0.25]
  default_dof_pos: [0.1, 0.8, -1.5]
  joint_names: [FL_hip_joint, FL_thigh_joint, FL_calf_joint]
  dt: 0.005
  decimation: 4
";
const LEGGED_GYM: &str = "class Go2Cfg(LeggedRobotCfg):
    class env(LeggedRobotCfg.env):
        num_observations = 48
    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {'FL_hip_joint': 0.1, 'RL_hip_joint': 0.1, 'FR_hip_joint': -0.1,  # [rad]
            'RR_hip_joint': -0.1, 'thigh': 0.8, 'calf_joint': -1.5}
    class control(LeggedRobotCfg.control):
        stiffness = {'joint': 20.}
        damping = {'joint': 0.5}
        action_scale = 0.25
";

fn written(name: &str) -> Vec<u8> {
    let spec = base_spec("walk", &go2(), vec!["alive".to_owned()], 20.0);
    let sizes = [spec.obs_len(), HIDDEN, spec.action_len()];
    let (normaliser, log_std) = (Normaliser::identity(spec.obs_len()), vec![0.0; spec.action_len()]);
    let policy = Policy { spec, normaliser, actor: Mlp::zeros(&sizes), log_std };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join(name);
    let result =
        if name.ends_with("onnx") { policy.write_onnx(&path) } else { policy.write(&path, PolicyOrigin::default()) };
    result.expect("a policy can be written");
    std::fs::read(path).expect("the policy was written")
}

/// Returns the state of a robot that lies.
fn upright() -> LowState {
    let imu_state = ImuState { quaternion: [1.0, 0.0, 0.0, 0.0], ..ImuState::default() };
    let motor = |index: usize| MotorState { q: index as f32, temperature: 30, ..MotorState::default() };
    LowState { imu_state, motor_state: std::array::from_fn(motor), power_v: 29.0, ..LowState::default() }
}

/// Reads an input of a format of this file. `path` is a file with its bytes.
pub fn read(format: Format, bytes: &[u8], path: &Path) -> Outcome {
    match format {
        Format::Policy => read_policy(path),
        Format::PolicyConfig | Format::PolicyConfigPy => match import_policy(&[path]) {
            Ok(imported) => Outcome::checked(Mapping::parse(&imported.mapping).is_ok()),
            Err(error) => {
                assert!(!error.to_string().is_empty(), "an error has a text");
                Outcome::Refused
            }
        },
        Format::Onnx => read_onnx(path),
        Format::Mapping => match std::str::from_utf8(bytes).map(|text| (text, Mapping::parse(text))) {
            Ok((_, Ok(mapping))) => Outcome::checked(mapping.input_len() > 0),
            Ok((text, Err(_))) if twinstep_effects::parse_toml::<toml::Table>(text).is_ok() => Outcome::Decoded,
            _ => Outcome::Refused,
        },
        Format::LowState => match decode::<LowState>(bytes) {
            // A checksum is seldom right after a change, so the values are checked in any case.
            Ok(state) => {
                let has_checksum = state.check_checksum().is_ok();
                Outcome::checked(Reading::new(&state).is_ok() && has_checksum)
            }
            Err(_) => Outcome::Refused,
        },
        _ => match decode::<RpcResponse>(bytes) {
            Ok(response) => Outcome::checked(serde_json::from_str::<serde_json::Value>(&response.data).is_ok()),
            Err(_) => Outcome::Refused,
        },
    }
}

fn read_policy(path: &Path) -> Outcome {
    match Policy::read(path) {
        Ok((policy, _)) => {
            let mut action = vec![0.0; policy.actor.outputs()];
            PolicyRunner::new(&policy).run(&vec![0.5; policy.normaliser.len()], &mut action);
            Outcome::Accepted
        }
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            Outcome::Refused
        }
    }
}

fn read_onnx(path: &Path) -> Outcome {
    match OnnxNetwork::read(path) {
        Ok(network) => {
            let inputs: Vec<Vec<f32>> = network.inputs().iter().map(|port| vec![0.5; port.len()]).collect();
            Outcome::checked(network.run(&inputs.iter().map(Vec::as_slice).collect::<Vec<_>>()).is_ok())
        }
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            Outcome::Refused
        }
    }
}
