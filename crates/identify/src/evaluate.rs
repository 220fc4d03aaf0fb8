//! Errors of a model on a log.

use serde::Serialize;
use std::collections::BTreeMap;
use twinstep_logs::Log;
use twinstep_logs::replay::at_log_rate;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use crate::error::ExperimentError;
use crate::experiment::Experiment;
use crate::torque::torque_errors;
use crate::window::WindowConfig;

/// Errors of a model on a log. Values are `None` if the log lacks the measurements.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Root mean square over joints and rows of the error of the actuators' torque on measured states [N·m].
    pub torque_rmse_nm: Option<f64>,
    /// Root mean square over joints and rows of the position error in closed loop [rad].
    pub q_rmse_rad: Option<f64>,
    /// Errors of each joint.
    pub per_joint: BTreeMap<String, JointEvaluation>,
}

/// Errors of one joint in an [`Evaluation`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct JointEvaluation {
    /// Root mean square of the torque error [N·m].
    pub torque_rmse_nm: Option<f64>,
    /// Root mean square of the position error [rad].
    pub q_rmse_rad: Option<f64>,
}

/// Evaluates `robot` on the rows of `log` that `keep` selects.
pub fn evaluate(
    log: &Log,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
    keep: impl Fn(usize) -> bool,
) -> Result<Evaluation, ExperimentError> {
    let experiment = Experiment::new(log, robot, WindowConfig::EVALUATION)?.filter_rows(&keep);
    let positions = experiment
        .position_errors(simulator, robot)
        .map(|errors| (errors.iter().map(|(_, error)| error * error).sum(), errors.len()));
    let torques = torque_errors(log, robot, simulator.actuator(&at_log_rate(log, robot)?), &keep)?;
    let root = |(sum, count): (f64, usize)| (count > 0).then(|| (sum / count as f64).sqrt());
    let whole = |sums: &[(f64, usize)]| {
        root(sums.iter().fold((0.0, 0), |(sum, count), (more, others)| (sum + more, count + others)))
    };
    let per_joint = experiment.joints().iter().map(|joint| {
        let index = joint.index();
        let evaluation = JointEvaluation {
            torque_rmse_nm: torques.and_then(|sums| root(sums[index])),
            q_rmse_rad: root(positions[index]),
        };
        (JOINT_NAMES[index].to_owned(), evaluation)
    });
    Ok(Evaluation {
        torque_rmse_nm: torques.and_then(|sums| whole(&sums)),
        q_rmse_rad: whole(&positions),
        per_joint: per_joint.collect(),
    })
}

/// Returns rows and closed-loop position errors of each joint, simulated minus measured [rad].
///
/// Only rows that `keep` selects are included. The first row of a window has no error, because the simulation starts
/// from its measured state.
pub fn position_errors(
    log: &Log,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
    keep: impl Fn(usize) -> bool,
) -> Result<[Vec<(usize, f64)>; NUM_JOINTS], ExperimentError> {
    Ok(Experiment::new(log, robot, WindowConfig::EVALUATION)?.filter_rows(keep).position_errors(simulator, robot))
}
