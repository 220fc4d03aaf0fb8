//! The torque that a model lacks in a log, as a log of its own, from which networks can learn it.

use twinstep_logs::replay::ReplayError;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel};

use crate::inverse_dynamics::InverseDynamicsResidual;
use crate::torque::MeasuredTorque;

/// Returns `log` with the torque that `robot` lacks at the log's sensor as its measured torque: measured minus modelled.
///
/// Returns `None` if no torque, or no velocity, was measured.
pub fn residual_at_sensor(log: &Log, robot: &RobotModel) -> Result<Option<Log>, ReplayError> {
    let mut torques: [Vec<f64>; NUM_JOINTS] = std::array::from_fn(|_| vec![f64::NAN; log.rows()]);
    MeasuredTorque::new(log, robot)?.differences(robot, |joint, row, difference| torques[joint][row] = -difference);
    Ok(with_torques(log, log.meta().tau_sensor, &torques))
}

/// Returns `log` with the torque that `robot` lacks at the joint output: that of the measured motion minus the modelled.
///
/// Returns `None` if the base is not fixed in any row, because contact forces are not measured.
pub fn residual_at_output(log: &Log, robot: &RobotModel) -> Result<Option<Log>, ReplayError> {
    let torques = InverseDynamicsResidual::of(log, robot)?.torque.map(|cells| cells.iter().map(|tau| -tau).collect());
    Ok(with_torques(log, TorqueSensor::JointOutput, &torques))
}

fn with_torques(log: &Log, sensor: TorqueSensor, torques: &[Vec<f64>; NUM_JOINTS]) -> Option<Log> {
    let known = JOINT_NAMES.iter().zip(torques).filter(|(_, cells)| cells.iter().any(|cell| cell.is_finite()));
    let torques: Vec<_> = known.map(|(joint, cells)| ((*joint).to_owned(), cells.clone())).collect();
    (!torques.is_empty()).then(|| log.with_torques(sensor, &torques))
}
