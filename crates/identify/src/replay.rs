//! A log and the closed-loop simulation of its commands, joint by joint.

use std::ops::Range;

use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout};

use crate::error::ExperimentError;
use crate::evaluate::position_errors;

/// Measured and simulated joint positions of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct Replay {
    /// The joints of the log, in the order of [`twinstep_model::Joint::ALL`].
    pub joints: Vec<JointError>,
    /// Time of each row [s].
    pub t: Vec<f64>,
    /// The contiguous row ranges of the log.
    pub ranges: Vec<Range<usize>>,
    /// Root mean square position error over all joints and rows [rad].
    pub rmse_rad: f64,
}

/// Measured and simulated positions of one joint, with one entry per row.
#[derive(Clone, Debug, PartialEq)]
pub struct JointError {
    /// Name of the joint.
    pub name: String,
    /// Root mean square of simulated minus measured position [rad].
    pub rmse_rad: f64,
    /// Largest absolute value of simulated minus measured position [rad].
    pub max_rad: f64,
    /// Measured position [rad].
    pub measured: Vec<f64>,
    /// Simulated position at the same time [rad].
    pub simulated: Vec<f64>,
    /// Commanded position [rad].
    pub command: Vec<f64>,
}

/// Simulates the commands of `log` from its measured states, in the windows of [`crate::WindowConfig::EVALUATION`].
///
/// In the first row of a window the simulated position is the measured one.
pub fn replay(log: &Log, robot: &RobotModel, simulator: &mut dyn Rollout) -> Result<Replay, ExperimentError> {
    let errors = position_errors(log, robot, simulator, |_| true)?;
    let mut joints = Vec::new();
    let (mut sum, mut count) = (0.0, 0);
    for (joint, errors) in twinstep_model::Joint::ALL.iter().zip(&errors) {
        let (Some(q), Some(q_cmd)) = (log.q(joint.name()), log.q_cmd(joint.name())) else { continue };
        let mut simulated = q.to_vec();
        for (row, error) in errors {
            simulated[*row] += error;
        }
        let squares = errors.iter().map(|(_, error)| error * error).sum::<f64>();
        sum += squares;
        count += errors.len();
        joints.push(JointError {
            name: joint.name().to_owned(),
            rmse_rad: (squares / errors.len().max(1) as f64).sqrt(),
            max_rad: errors.iter().map(|(_, error)| error.abs()).fold(0.0, f64::max),
            measured: q.to_vec(),
            simulated,
            command: q_cmd.to_vec(),
        });
    }
    Ok(Replay {
        joints,
        t: log.t().to_vec(),
        ranges: log.segments().map(|(_, rows)| rows).collect(),
        rmse_rad: (sum / count.max(1) as f64).sqrt(),
    })
}
