//! The errors of a model on a log.

use serde::Serialize;
use std::collections::BTreeMap;
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use crate::experiment::{Experiment, ExperimentError};
use crate::torque::torque_errors;
use crate::window::WindowConfig;

/// How far a model is from a log; null where the log cannot tell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Root mean square over joints and rows of the actuators' torque on measured states [N·m].
    pub torque_rmse_nm: Option<f64>,
    /// Root mean square over joints and rows of the position error in closed loop [rad].
    pub q_rmse_rad: Option<f64>,
    /// The same, joint by joint.
    pub per_joint: BTreeMap<&'static str, JointEvaluation>,
}

/// One joint's part of an [`Evaluation`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct JointEvaluation {
    /// [N·m]
    pub torque_rmse_nm: Option<f64>,
    /// [rad]
    pub q_rmse_rad: Option<f64>,
}

/// Evaluates `robot` on `log`; `keep` chooses the rows that count.
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
    let torques = torque_errors(log, robot, &keep)?;
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
        (JOINT_NAMES[index], evaluation)
    });
    Ok(Evaluation {
        torque_rmse_nm: torques.and_then(|sums| whole(&sums)),
        q_rmse_rad: whole(&positions),
        per_joint: per_joint.collect(),
    })
}

/// Simulated less measured position [rad] in closed loop, by joint: each with its row, of the rows that `keep` chooses.
///
/// A row where the robot is put down as it was measured has none.
pub fn position_errors(
    log: &Log,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
    keep: impl Fn(usize) -> bool,
) -> Result<[Vec<(usize, f64)>; NUM_JOINTS], ExperimentError> {
    Ok(Experiment::new(log, robot, WindowConfig::EVALUATION)?.filter_rows(keep).position_errors(simulator, robot))
}
