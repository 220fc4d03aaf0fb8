//! Robot model of the flag `--model`.

use std::path::Path;

use twinstep_effects::ModelFile;
use twinstep_model::{RobotModel, go2};

use crate::exit::{Failure, input};

/// Returns a model file whose actuators are laws, not networks, or the ideal Go2 for `None`.
pub fn analytic_model(path: Option<&Path>) -> Result<ModelFile, Failure> {
    path.map_or(Ok(ModelFile::default()), ModelFile::load_without_actuator_network).map_err(input)
}

/// Returns the robot of a model file, or the ideal Go2 for `None`.
pub fn robot_model(path: Option<&Path>) -> Result<RobotModel, Failure> {
    path.map_or_else(|| Ok(go2()), |path| twinstep_effects::load_robot(path).map_err(input))
}
