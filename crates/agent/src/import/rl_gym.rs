//! Configs of the deployment programs of unitree_rl_gym and its descendants: `deploy_real/configs/*.yaml`,
//! `deploy_mujoco/configs/*.yaml`.
//!
//! `joint2motor_idx` or `leg_joint2motor_idx` gives the motor of each joint of the policy; without it the order is that of the
//! MuJoCo model, leg by leg. Configs of humanoids with twelve joints in their legs have the same keys; their pose is outside the ranges of
//! a quadruped, which the merge finds. Gains are lists (`kps`) or one number (`ctrl_kp`). The order of the observation is in no config.

use super::facts::{BY_LEG, BY_MOTOR, Facts, InputFacts, history};
use super::legged_gym::ObservationOrder;
use super::yaml::Yaml;
use crate::mapping::{HistoryLayout, HistoryOrder};

/// Reads the file. `inputs` is the length of the network's input, if it is known.
pub fn read(source: &str, yaml: &Yaml, inputs: Option<usize>) -> Result<Facts, String> {
    let mut facts = Facts { source: source.to_owned(), ..Facts::default() };
    let list = |key: &str| yaml.get(key).and_then(Yaml::one_or_more);
    let number = |key: &str| yaml.get(key).and_then(Yaml::number);
    // The first of several keys that the file has.
    let any = |keys: [&'static str; 2]| keys.into_iter().find_map(|key| list(key).map(|values| (key, values)));
    facts.joints = Some(if let Some((key, motors)) = any(["joint2motor_idx", "leg_joint2motor_idx"]) {
        facts.found(names(key, &motors)?, &format!("{key}, the motors of the Go2"))
    } else {
        facts.notes.push("the config does not name the joints: FL, FR, RL, RR, leg by leg, are taken".to_owned());
        facts.found(BY_LEG.map(str::to_owned).to_vec(), "no joint2motor_idx: leg by leg")
    });
    facts.kp = any(["kps", "ctrl_kp"]).map(|(key, gains)| facts.found(gains, key));
    facts.kd = any(["kds", "ctrl_kd"]).map(|(key, gains)| facts.found(gains, key));
    facts.default_pose = list("default_angles").map(|pose| facts.found(pose, "default_angles"));
    facts.action_scale = list("action_scale").map(|scale| facts.found(scale, "action_scale"));
    let simulated = number("simulation_dt").zip(number("control_decimation")).map(|(dt, count)| dt * count);
    facts.policy_hz = match (number("control_dt"), simulated) {
        (Some(dt), _) => Some(facts.found(1.0 / dt, "control_dt")),
        (None, dt) => dt.map(|dt| facts.found(1.0 / dt, "simulation_dt · control_decimation")),
    };
    let step = number("num_obs").or_else(|| number("num_single_obs")).map(|len| len as usize);
    let steps = number("frame_stack").unwrap_or(1.0).clamp(1.0, 1e3) as usize;
    // A network with several inputs reads the present observation apart from the history.
    let is_stacked = inputs.is_none() || inputs == step.map(|step| step * steps);
    match ObservationOrder::of([step, inputs]) {
        Some(order) => {
            let scale = |key: &str| number(&format!("{key}_scale")).or_else(|| number(&format!("obs_scales_{key}")));
            let command = any(["cmd_scale", "command_scale"]).map_or_else(Vec::new, |(_, scale)| scale);
            let history = history(if is_stacked { steps } else { 1 }, HistoryLayout::Frames, HistoryOrder::OldestFirst);
            let input = InputFacts { terms: order.terms(&scale, command), unknown: Vec::new(), history };
            facts.observation = Some(facts.found(input, "number of observations"));
            facts.is_order_assumed = true;
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

fn names(key: &str, motors: &[f64]) -> Result<Vec<String>, String> {
    let name = |motor: &f64| {
        BY_MOTOR.iter().enumerate().find(|(index, _)| *index as f64 == *motor).map(|(_, name)| (*name).to_owned())
    };
    let names: Option<Vec<String>> = motors.iter().map(name).collect();
    names
        .filter(|names| names.len() == BY_MOTOR.len())
        .ok_or_else(|| format!("`{key}` = {motors:?}; the indices of twelve motors, 0 to 11, are expected"))
}
