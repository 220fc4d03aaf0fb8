//! The robot that `--model` names.

use std::path::Path;

use twinstep_model::{RobotModel, go2};

use crate::exit::{Failure, input};

/// The robot of a model file; the ideal Go2 without.
pub fn robot_model(path: Option<&Path>) -> Result<RobotModel, Failure> {
    path.map_or_else(|| Ok(go2()), |path| twinstep_effects::load_robot(path).map_err(input))
}
