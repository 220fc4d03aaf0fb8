//! Diagnosis of a robot of any tree: the causes of highest evidence in the equations of its logs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use twinstep_effects::{JointEffect, JointScope, NominalGain, TreeModelFile};
use twinstep_inference::equations::{Explanation, explain_tree, torque_error};
use twinstep_inference::{
    Candidate, IdentifyOptions, InferenceError, JointLog, ParameterRequest, evaluate, identify, joint_indices,
};
use twinstep_logs::Log;
use twinstep_model::TreeModel;

use super::data_split::fitted_rows;
use super::explained::{also_fitted, confusable, finding, not_reported, unexplained_law};
use super::findings::{Diagnosis, RmsErrors};
use super::{DiagnoseError, DiagnoseProgress, held_out_rows};

/// Time that is simulated to estimate gains [s], in blocks of this length [s].
const MOST_S: f64 = 40.0;
const BLOCK_S: f64 = 4.0;

/// Result of a diagnosis of a robot of any tree.
#[derive(Clone, Debug)]
pub struct TreeDiagnosis {
    /// The findings. The caller that writes the files sets `extended_model`.
    pub diagnosis: Diagnosis,
    /// The given model with unknown gains, the causes and their intervals.
    pub extended: TreeModelFile,
}

/// Identifies the effects that a robot of any tree lacks, from `logs` of one robot.
///
/// Gains that neither the logs nor the model file state are estimated first, with frictions, inertias and a delay. Simulations end soon
/// after `stop` is true; `progress` must return false then.
pub fn diagnose_tree(
    logs: &[Log],
    file: &TreeModelFile,
    actuator_hz: f64,
    stop: &Arc<AtomicBool>,
    progress: &mut DiagnoseProgress,
) -> Result<TreeDiagnosis, DiagnoseError> {
    for log in logs {
        log.check_measurements_per_period()?;
    }
    let joined = Log::joined(logs).ok_or(DiagnoseError::Unlike)?;
    let is_used: Vec<bool> = logs.iter().flat_map(fitted_rows).collect();
    let held_out: Vec<bool> = logs.iter().flat_map(held_out_rows).collect();
    let (given, estimates) = with_gains(file, &joined, &is_used, actuator_hz, (stop, progress))?;
    let robot = Candidate::of(&given)?;
    let joined = with_gains_of(joined, &robot);
    let mut go_on = |text: &str| progress(text);
    let found = explain_tree(&joined, &robot, estimates.as_ref(), (actuator_hz, stop), |row| is_used[row], &mut go_on)?;
    // Simulations that were ended have left nothing to report.
    let found = found.filter(|_| !stop.load(Ordering::Relaxed)).ok_or(DiagnoseError::Interrupted)?;
    let joints: Vec<String> = file.nominal.tree.joints.iter().map(|joint| joint.name.clone()).collect();
    let extended = extended(&given, found.all(), &joints);
    let errors = |file: &TreeModelFile| errors(&joined, file, &held_out, actuator_hz);
    let diagnosis = Diagnosis {
        baseline: errors(&given)?,
        extended: errors(&extended)?,
        noise_floor: noise_floor(&joined),
        findings: found.causes.iter().map(|cause| finding(cause, &joints)).collect(),
        joint_gains: std::collections::BTreeMap::new(),
        also_fitted: also_fitted(&found, &joints),
        confusable: confusable(&found),
        unexplained: unexplained_law(&found),
        promise: None,
        learned_residual: None,
        next_experiment: None,
        not_reported: not_reported(&found),
        decisions: found.decisions,
        extended_model: String::new(),
    };
    Ok(TreeDiagnosis { diagnosis, extended })
}

/// Returns the model with estimates of the gains that the log does not state, and the robot with what was estimated together with them.
fn with_gains(
    file: &TreeModelFile,
    log: &Log,
    is_used: &[bool],
    actuator_hz: f64,
    (stop, progress): (&Arc<AtomicBool>, &mut DiagnoseProgress),
) -> Result<(TreeModelFile, Option<TreeModel>), DiagnoseError> {
    let of_file =
        |gains: &Option<NominalGain>, joint: &str| gains.as_ref().is_some_and(|gains| gains.of(joint).is_some());
    let is_known = |joint: &String| {
        let pairs = log.gains(joint).map(|gain| gain.is_some()).into_iter().zip([&file.kp, &file.kd]);
        let names: Vec<&str> = joint_indices(std::slice::from_ref(joint), &file.nominal.tree)
            .map_or(Vec::new(), |found| vec![&file.nominal.tree.joints[found[0]].name]);
        pairs.into_iter().all(|(stated, gains)| stated || names.iter().any(|name| of_file(gains, name)))
    };
    if log.joints().iter().all(is_known) {
        return Ok((file.clone(), None));
    }
    // The gains of a long log show in a part of it.
    let block = (BLOCK_S * log.meta().rate_hz).max(1.0) as usize;
    let step = (log.duration_s() / MOST_S).ceil().max(1.0) as usize;
    let is_kept = |row: usize| is_used[row] && (row / block).is_multiple_of(step);
    let joint_log = JointLog::new(log, &file.nominal.tree, is_kept)?;
    let requests = ParameterRequest::DEFAULT.map(|request| ParameterRequest(request.to_owned())).to_vec();
    let options = IdentifyOptions { requests, actuator_hz, stop: stop.clone() };
    let mut each = |round: usize, rounds: usize, _| {
        if !progress(&format!("estimating the gains that the log does not state, round {round} of {rounds}")) {
            stop.store(true, Ordering::Relaxed);
        }
    };
    let found = identify(file, &joint_log, &options, &mut each)?;
    if found.interrupted {
        return Err(DiagnoseError::Interrupted);
    }
    let estimates = found.model.tree_model().ok();
    Ok((TreeModelFile { kp: found.model.kp, kd: found.model.kd, ..file.clone() }, estimates))
}

/// Returns the log with the gains of a robot where it states none.
fn with_gains_of(log: Log, robot: &Candidate) -> Log {
    log.with_gains(|name| {
        let joint = joint_indices(&[name.to_owned()], &robot.robot.tree).ok()?[0];
        Some([robot.kp[joint], robot.kd[joint]])
    })
}

/// Returns the model with effects and their intervals.
fn extended<'a>(
    file: &TreeModelFile,
    causes: impl Iterator<Item = &'a Explanation>,
    joints: &[String],
) -> TreeModelFile {
    let mut extended = file.clone();
    for cause in causes {
        let entry = |scope: JointScope, values: &[f64], intervals: &[[f64; 2]]| JointEffect {
            effect: cause.effect,
            scope,
            values: values.to_vec(),
            intervals: intervals.iter().map(|interval| Some(*interval)).collect(),
        };
        if cause.by_joint.is_empty() {
            let scope = match cause.scope.as_str() {
                "all" => JointScope::All,
                joint => JointScope::Joint(joint.to_owned()),
            };
            extended.effects.push(entry(scope, &cause.values, &cause.intervals));
            continue;
        }
        for own in &cause.by_joint {
            let scope = JointScope::Joint(joints[own.joint].clone());
            extended.effects.push(entry(scope, &own.values, &own.intervals));
        }
    }
    extended
}

/// Returns the errors of a model in rows: of positions on a fixed base, and of torques if motor currents were measured.
fn errors(log: &Log, file: &TreeModelFile, rows: &[bool], actuator_hz: f64) -> Result<RmsErrors, DiagnoseError> {
    let candidate = Candidate::of(file)?;
    let has_bodies = file.nominal.tree.bodies.iter().any(|body| body.inertia.mass > 0.0);
    let q_rmse_rad = match JointLog::new(log, &file.nominal.tree, |row| rows[row]) {
        Ok(_) if !has_bodies => None,
        Ok(joint_log) => match evaluate(&joint_log, &candidate, actuator_hz) {
            Ok((found, _)) => found.q_rmse_rad,
            Err(InferenceError::Diverges) => None,
            Err(error) => return Err(error.into()),
        },
        // The base is free.
        Err(InferenceError::NothingToSimulate) => None,
        Err(error) => return Err(error.into()),
    };
    let torque_rmse_nm = torque_error(log, &candidate.robot, |row| rows[row]);
    Ok(RmsErrors { torque_rmse_nm, q_rmse_rad })
}

/// Returns the errors due to the noise that the log states.
fn noise_floor(log: &Log) -> RmsErrors {
    let mean = |quantity: &str| {
        let all = log.joints().iter().map(|joint| log.noise(&format!("{quantity}_{joint}")));
        let squares: Option<Vec<f64>> = all.map(|noise| noise.map(|noise| noise * noise)).collect();
        squares.map(|squares| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt())
    };
    RmsErrors { torque_rmse_nm: mean("tau_measured"), q_rmse_rad: mean("q") }
}
