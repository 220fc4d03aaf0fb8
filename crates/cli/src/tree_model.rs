//! Model of the flag `--model` for a robot of any tree.

use std::path::Path;

use twinstep_effects::{ModelFile, ModelFileError, NominalGain, NominalRobotError, TreeModelFile};
use twinstep_inference::JointLog;
use twinstep_logs::Log;
use twinstep_logs::replay::check_gains;

use crate::exit::{Failure, input};

/// Rate of the actuators of a robot of any tree [Hz], if its model file states none.
const ACTUATOR_HZ: f64 = 1000.0;

/// Returns the model of a tree, if the robot is not like the Go2 or the gains of the log are unknown.
pub fn tree_model(path: Option<&Path>, log: &Log) -> Result<Option<TreeModelFile>, Failure> {
    let unknown_gains = check_gains(log).is_err();
    let Some(path) = path else { return Ok(unknown_gains.then(TreeModelFile::go2)) };
    let is_tree = unknown_gains
        || match ModelFile::load(path) {
            Err(ModelFileError::OfTree { .. }) => true,
            Err(ModelFileError::Robot { cause, .. }) => matches!(*cause, NominalRobotError::Import { .. }),
            // The caller says what is wrong with the file of a quadruped.
            _ => false,
        };
    if is_tree { of_any_tree(Some(path)).map(Some) } else { Ok(None) }
}

/// Returns the model of a tree, also for a quadruped; the ideal Go2 for `None`.
pub fn of_any_tree(path: Option<&Path>) -> Result<TreeModelFile, Failure> {
    path.map_or_else(|| Ok(TreeModelFile::go2()), |path| TreeModelFile::load(path).map_err(input))
}

/// Returns the rate of the actuators [Hz].
pub fn actuator_hz(file: &TreeModelFile) -> f64 {
    file.actuator_hz.unwrap_or(ACTUATOR_HZ)
}

/// Says on stderr what stands for gains that the log does not state.
pub fn note_unknown_gains(file: &TreeModelFile, log: &JointLog) {
    if !log.has_unknown_gains() {
        return;
    }
    let stated = |gains: &Option<NominalGain>| {
        log.joints.iter().all(|joint| gains.as_ref().is_some_and(|gains| gains.of(&joint.name).is_some()))
    };
    let source = if stated(&file.kp) && stated(&file.kd) {
        "those of the model file stand for them"
    } else {
        "3 (kp) and 0.1 s (kd) times the torque limit per radian stand for them"
    };
    eprintln!("note: the log does not state the gains of all joints; {source}");
}
