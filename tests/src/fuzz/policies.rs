//! Policies and what the robot sends: examples, and reading as `twinstep run` and `twinstep robot` do.

use std::path::Path;

use twinstep_agent::{Mapping, OnnxNetwork};
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
        Format::Onnx => vec![written("policy.onnx")],
        Format::Mapping => examples_in("data/policies/mappings", "", ".toml"),
        Format::LowState => vec![encode(&upright().with_checksum())],
        _ => vec![encode(&RpcResponse { id: 7, api_id: 1001, data: SERVICE.to_owned(), ..RpcResponse::default() })],
    }
}

/// Answer of the service that says which controller is active.
const SERVICE: &str = r#"{"form":"0","name":"mcf"}"#;

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
        Format::Onnx => read_onnx(path),
        Format::Mapping => match std::str::from_utf8(bytes).map(|text| (text, Mapping::parse(text))) {
            Ok((_, Ok(mapping))) => Outcome::checked(mapping.input_len() > 0),
            Ok((text, Err(_))) if text.parse::<toml::Table>().is_ok() => Outcome::Decoded,
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
