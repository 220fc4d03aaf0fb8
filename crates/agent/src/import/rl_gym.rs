//! Configs of the deployment programs of unitree_rl_gym: `deploy_real/configs/*.yaml` and `deploy_mujoco/configs/*.yaml`.
//!
//! `joint2motor_idx` gives the motor of each joint of the policy; without it the order is that of the MuJoCo model, leg by leg.
//! The observation is that of the program, by its length.

use super::facts::{BY_LEG, BY_MOTOR, Facts, InputFacts};
use super::legged_gym::ObservationOrder;
use super::yaml::Yaml;

/// Reads the file. `inputs` is the length of the network's input, if it is known.
pub fn read(source: &str, yaml: &Yaml, inputs: Option<usize>) -> Result<Facts, String> {
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    check_robot(yaml)?;
    let list = |key: &str| yaml.get(key).and_then(Yaml::one_or_more);
    let number = |key: &str| yaml.get(key).and_then(Yaml::number);
    facts.joints = Some(if let Some(motors) = list("joint2motor_idx") {
        facts.found(names(&motors)?, "joint2motor_idx, the motors of the Go2")
    } else {
        facts.notes.push("the config does not name the joints: FL, FR, RL, RR, leg by leg, are taken".to_owned());
        facts.found(BY_LEG.map(str::to_owned).to_vec(), "no joint2motor_idx: leg by leg")
    });
    facts.kp = list("kps").map(|gains| facts.found(gains, "kps"));
    facts.kd = list("kds").map(|gains| facts.found(gains, "kds"));
    facts.default_pose = list("default_angles").map(|pose| facts.found(pose, "default_angles"));
    facts.action_scale = list("action_scale").map(|scale| facts.found(scale, "action_scale"));
    let simulated = number("simulation_dt").zip(number("control_decimation")).map(|(dt, count)| dt * count);
    facts.policy_hz = match (number("control_dt"), simulated) {
        (Some(dt), _) => Some(facts.found(1.0 / dt, "control_dt")),
        (None, dt) => dt.map(|dt| facts.found(1.0 / dt, "simulation_dt · control_decimation")),
    };
    let step = number("num_obs").map(|len| len as usize);
    match ObservationOrder::of([step, inputs]) {
        Some(order) => {
            let scale = |key: &str| number(&format!("{key}_scale")).or_else(|| number(&format!("obs_scales_{key}")));
            let command = list("cmd_scale").or_else(|| list("command_scale")).unwrap_or_default();
            let input = InputFacts { terms: order.terms(&scale, command), ..InputFacts::default() };
            facts.observation = Some(facts.found(input, "num_obs"));
            facts.notes.push(format!(
                "the config does not contain the order of the observation: {} is taken; compare it with the program that runs the policy",
                order.description()
            ));
        }
        None => facts.notes.push(format!(
            "the config does not say what its {} observations are; add [[observation]] from the program that runs the policy",
            step.map_or_else(|| "?".to_owned(), |step| step.to_string())
        )),
    }
    Ok(facts)
}

/// The configs of humanoids have the same keys, and legs of six joints.
fn check_robot(yaml: &Yaml) -> Result<(), String> {
    let path =
        ["xml_path", "policy_path"].into_iter().find_map(|key| yaml.get(key).and_then(Yaml::text)).unwrap_or_default();
    let is_humanoid = |part: &str| ["g1", "h1", "h1_2", "g1_description", "h1_description"].contains(&part);
    if yaml.get("leg_joint2motor_idx").is_some() || path.split('/').any(is_humanoid) {
        return Err(
            "it is the config of a humanoid with twelve joints in its legs; the endpoints have robots with four legs"
                .to_owned(),
        );
    }
    Ok(())
}

fn names(motors: &[f64]) -> Result<Vec<String>, String> {
    let name = |motor: &f64| {
        BY_MOTOR.iter().enumerate().find(|(index, _)| *index as f64 == *motor).map(|(_, name)| (*name).to_owned())
    };
    let names: Option<Vec<String>> = motors.iter().map(name).collect();
    names
        .filter(|names| names.len() == BY_MOTOR.len())
        .ok_or_else(|| format!("`joint2motor_idx` = {motors:?}; the indices of twelve motors, 0 to 11, are expected"))
}
