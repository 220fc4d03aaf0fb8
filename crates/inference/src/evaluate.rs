//! Errors of a model on a log.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use twinstep_identify::{Evaluation, JointEvaluation};

use crate::{Candidate, InferenceError, JointLog, WindowLength, simulate, windows};

/// Simulated minus measured position [rad] with its row, by joint of the log.
pub type PositionErrors = BTreeMap<String, Vec<(usize, f64)>>;

/// Evaluates a candidate in closed loop: each contiguous range of rows is simulated from its first measured state to its end.
///
/// The torque is that of the motors in the same simulation.
pub fn evaluate(
    log: &JointLog,
    candidate: &Candidate,
    actuator_hz: f64,
) -> Result<(Evaluation, PositionErrors), InferenceError> {
    let windows = windows(log, &candidate.robot.tree, WindowLength::WholeRanges);
    let traces =
        simulate(log, &windows, std::slice::from_ref(candidate), actuator_hz, &AtomicBool::new(false))?.remove(0);
    let (mut errors, mut per_joint) = (PositionErrors::new(), BTreeMap::new());
    let (mut all_q, mut all_tau) = (Vec::new(), Vec::new());
    for (index, channels) in log.joints.iter().enumerate() {
        let (mut q, mut tau) = (Vec::new(), Vec::new());
        for (window, trace) in windows.iter().zip(&traces) {
            for row in window.first_compared..window.rows.end {
                let inner = row - window.rows.start;
                if channels.q[row].is_finite() {
                    q.push((row, trace.q[index][inner] - channels.q[row]));
                }
                tau.extend(channels.tau.as_ref().map(|tau| trace.tau[index][inner] - tau[row]).filter(|e| !e.is_nan()));
            }
        }
        if q.iter().any(|(_, error)| !error.is_finite()) {
            return Err(InferenceError::Diverges);
        }
        let positions: Vec<f64> = q.iter().map(|(_, error)| *error).collect();
        let evaluation = JointEvaluation { torque_rmse_nm: rms(&tau), q_rmse_rad: rms(&positions) };
        per_joint.insert(channels.name.clone(), evaluation);
        all_q.extend(positions);
        all_tau.extend(tau);
        errors.insert(channels.name.clone(), q);
    }
    Ok((Evaluation { torque_rmse_nm: rms(&all_tau), q_rmse_rad: rms(&all_q), per_joint }, errors))
}

fn rms(errors: &[f64]) -> Option<f64> {
    let sum = errors.iter().map(|error| error * error).sum::<f64>();
    (!errors.is_empty()).then(|| (sum / errors.len() as f64).sqrt())
}
