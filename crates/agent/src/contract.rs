//! The contract of a policy: gains, default pose, action scale and rates that an endpoint must have to run it.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use twinstep_effects::{ControlTable, JointGains, parse_toml};
use twinstep_model::{EnvSpec, JOINT_NAMES, NUM_JOINTS};
use twinstep_policy::Policy;

use crate::error::AgentError;
use crate::mapping::Mapping;
use crate::onnx::OnnxNetwork;

/// Rate that actuators have at least [Hz].
const MIN_ACTUATOR_HZ: f64 = 200.0;

/// A TOML file with a table `[control]`, such as a model file; its other keys do not matter here.
#[derive(Deserialize)]
struct WithControl {
    control: ControlTable,
}

/// Reads the contract of a policy as the table `[control]` of a model file.
///
/// It is that of a policy of `twinstep train` (`*.safetensors`, `*.onnx`), of a mapping, or the table `[control]` of a TOML file.
pub fn read_contract(path: impl AsRef<Path>) -> Result<ControlTable, AgentError> {
    let path = path.as_ref();
    let failed = |reason: String| AgentError::Contract { path: path.to_owned(), reason };
    match path.extension().and_then(|end| end.to_str()).unwrap_or_default() {
        "safetensors" => of_spec(&Policy::read(path)?.0.spec).map_err(failed),
        "onnx" => {
            let network = OnnxNetwork::read(path)?;
            let spec = network.metadata("spec").ok_or_else(|| {
                failed("it is the network of another program, without gains: state its mapping instead".to_owned())
            })?;
            of_spec(&serde_json::from_str(spec).map_err(|error| failed(error.to_string()))?).map_err(failed)
        }
        "toml" => {
            let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
            let table: toml::Table = parse_toml(&text).map_err(|error| failed(error.to_string()))?;
            if table.contains_key("control") {
                let file: WithControl = parse_toml(&text).map_err(|error| failed(error.to_string()))?;
                return Ok(file.control);
            }
            contract_of_mapping(&Mapping::parse(&text).map_err(failed)?).map_err(failed)
        }
        _ => Err(failed("a policy, a mapping or a TOML file with [control] is expected".to_owned())),
    }
}

fn of_spec(spec: &EnvSpec) -> Result<ControlTable, String> {
    if spec.joint_order != JOINT_NAMES {
        return Err(format!("its joints are {}; those of the Go2 are expected", spec.joint_order.join(" ")));
    }
    let gains = |gain: usize| JointGains::Each(std::array::from_fn(|joint| spec.gains(joint)[gain]));
    let pose: [f64; NUM_JOINTS] = spec.default_pose[..]
        .try_into()
        .map_err(|_| format!("its default pose has {} joints", spec.default_pose.len()))?;
    Ok(ControlTable {
        kp: Some(simple(gains(0))),
        kd: Some(simple(gains(1))),
        action_scale: Some(spec.action_scale),
        default_pose: Some(pose),
        actuator_hz: Some(rounded(1.0 / spec.actuator_dt)),
        policy_hz: Some(rounded(1.0 / spec.policy_dt)),
    })
}

/// Returns the contract of a mapping as the table `[control]` of a model file.
pub fn contract_of_mapping(mapping: &Mapping) -> Result<ControlTable, String> {
    let names = mapping.joints.iter().map(|name| name.strip_suffix("_joint").unwrap_or(name));
    let index: BTreeMap<&str, usize> = names.enumerate().map(|(index, name)| (name, index)).collect();
    let mut order = [0; NUM_JOINTS];
    for (place, joint) in order.iter_mut().zip(JOINT_NAMES) {
        *place = *index
            .get(joint)
            .ok_or_else(|| format!("`joints` has no {joint}; twelve joints of the Go2 are expected"))?;
    }
    let gains =
        |numbers: &crate::mapping::Numbers| simple(JointGains::Each(order.map(|index| exact(numbers.of(index)))));
    let policy_hz = mapping.policy_hz;
    let decimation = (MIN_ACTUATOR_HZ / policy_hz - 1e-9).ceil().max(1.0);
    Ok(ControlTable {
        kp: Some(gains(&mapping.kp)),
        kd: Some(gains(&mapping.kd)),
        action_scale: Some(exact(mapping.max_offset())),
        default_pose: Some(order.map(|index| mapping.default_pose[&mapping.joints[index]])),
        actuator_hz: Some(decimation * policy_hz),
        policy_hz: Some(policy_hz),
    })
}

/// Returns one gain for all joints if they are equal.
fn simple(gains: JointGains) -> JointGains {
    let each = gains.by_joint();
    if each.iter().all(|gain| *gain == each[0]) { JointGains::All(each[0]) } else { gains }
}

/// Returns the number that a file has: 0.1 for the single-precision 0.1.
fn exact(number: f32) -> f64 {
    number.to_string().parse().unwrap_or(f64::from(number))
}

/// Returns a rate without the rounding of its period.
fn rounded(hz: f64) -> f64 {
    if (hz - hz.round()).abs() < 1e-9 * hz { hz.round() } else { hz }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The joints in reverse order, with a stiff calf.
    fn mapping() -> String {
        let names: Vec<String> = JOINT_NAMES.iter().rev().map(|name| format!("\"{name}_joint\"")).collect();
        let pose: Vec<String> =
            JOINT_NAMES.iter().enumerate().map(|(index, name)| format!("{name}_joint = {index}.5")).collect();
        let kp = JOINT_NAMES.iter().rev().map(|name| if name.ends_with("calf") { "40.0" } else { "20.1" });
        format!(
            "joints = [{}]\naction_scale = 0.25\nkp = [{}]\nkd = 0.5\npolicy_hz = 60\n[default_pose]\n{}\n\
             [[observation]]\nterm = \"joint_position\"\n",
            names.join(", "),
            kp.collect::<Vec<_>>().join(", "),
            pose.join("\n")
        )
    }

    #[test]
    fn contract_of_a_mapping_has_the_order_of_the_robot() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("mapping.toml");
        std::fs::write(&path, mapping()).expect("written");
        let control = read_contract(&path).expect("a contract");
        let kp = control.kp.expect("gains").by_joint();
        assert_eq!(kp[..3], [20.1, 20.1, 40.0], "{kp:?}");
        assert_eq!(control.default_pose.expect("a pose")[..3], [0.5, 1.5, 2.5]);
        assert_eq!((control.kd, control.action_scale), (Some(JointGains::All(0.5)), Some(1.0)));
        assert_eq!((control.policy_hz, control.actuator_hz), (Some(60.0), Some(240.0)));
    }

    #[test]
    fn file_without_a_contract_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("mapping.toml");
        std::fs::write(&path, mapping().replace("\"FL_hip_joint\"", "\"FL_hop\"").replace("FL_hip_joint", "FL_hop"))
            .expect("written");
        let error = read_contract(&path).expect_err("an unknown joint").to_string();
        assert!(error.contains("`joints` has no FL_hip"), "{error}");
        let error = read_contract(folder.path().join("policy.pt")).expect_err("unknown").to_string();
        assert!(error.contains("a policy, a mapping or a TOML file"), "{error}");
    }
}
