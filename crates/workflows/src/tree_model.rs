//! Model of the flag `--model` for a robot of any tree.

use std::path::Path;

use twinstep_effects::{NominalGain, TreeModelFile};
use twinstep_env_server::is_of_tree;
use twinstep_inference::JointLog;
use twinstep_logs::Log;
use twinstep_logs::replay::check_gains;

use crate::failure::{Failure, input};
use crate::observer::Observer;

/// Rate of the actuators of a robot of any tree [Hz], if its model file states none.
const ACTUATOR_HZ: f64 = 1000.0;

/// Distance from its range at which a position is probably not in radians [rad].
const FAR_RAD: f64 = 0.5;

/// Returns the model of a tree, if the robot is not like the Go2 or the gains of the log are unknown.
pub fn tree_model(path: Option<&Path>, log: &Log) -> Result<Option<TreeModelFile>, Failure> {
    let gains = check_gains(log);
    let unknown_gains = gains.is_err();
    if !log.segments().any(|(segment, _)| segment.base.is_fixed()) {
        // Unknown gains of a robot with a free base cannot be estimated.
        gains.map_err(input)?;
    }
    let Some(path) = path else { return Ok(unknown_gains.then(TreeModelFile::go2)) };
    if unknown_gains || is_of_tree(path) { of_any_tree(Some(path)).map(Some) } else { Ok(None) }
}

/// Returns the model of a tree, also for a quadruped; the ideal Go2 for `None`.
pub fn of_any_tree(path: Option<&Path>) -> Result<TreeModelFile, Failure> {
    path.map_or_else(|| Ok(TreeModelFile::go2()), |path| TreeModelFile::load(path).map_err(input))
}

/// Returns the rate of the actuators [Hz].
pub fn actuator_hz(file: &TreeModelFile) -> f64 {
    file.actuator_hz.unwrap_or(ACTUATOR_HZ)
}

/// Notes what stands for gains that the log does not state, and which positions are far outside the range of their joint.
pub fn note_assumptions(file: &TreeModelFile, log: &JointLog, observer: &Observer) {
    let tree = &file.nominal.tree;
    let stated =
        |gains: &Option<NominalGain>, joint: &str| gains.as_ref().is_some_and(|gains| gains.of(joint).is_some());
    for channels in &log.joints {
        let name = &tree.joints[channels.joint].name;
        let gains = [("kp", &channels.kp, &file.kp, "3"), ("kd", &channels.kd, &file.kd, "0.1 s")];
        for (key, of_log, of_file, share) in gains {
            if of_log.is_none() && !stated(of_file, name) {
                observer.note(format_args!(
                    "note: neither log nor model file states {key} of {name}; {share} times the torque limit per radian stands for it"
                    ));
            }
        }
        let [low, high] = file.nominal.joints[channels.joint].range;
        let beyond = |q: &&f64| **q < low - FAR_RAD || **q > high + FAR_RAD;
        if let Some(q) = channels.q.iter().chain(&channels.q_cmd).find(beyond) {
            observer.note(format_args!(
                "note: {name} is at {q:.2}, and its range is {low:.2} to {high:.2} rad: is the log in degrees, or its zero another one?"
                ));
        }
    }
}
