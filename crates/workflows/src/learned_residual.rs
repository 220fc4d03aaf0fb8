//! The torque that no cause of a diagnosis explains, learned by an ensemble of networks.
//!
//! The networks are trained without the held-out blocks, and kept only if they reduce the closed-loop error there. Then
//! they are trained again on all rows, like the causes.

use std::path::PathBuf;

use twinstep_diagnose::{DiagnosisOutput, LearnedResidual, RmsErrors};
use twinstep_effects::{ActuatorNetworkConfig, ModelFile, NetworkMode};
use twinstep_ensemble::{
    ActuatorNetworkRobot, DataOptions, DataSet, Ensemble, EnsembleError, JointEncoding, NetworkInput, NetworkTarget,
    Split, Training, TrainingOptions, TrainingResult, epistemic_uncertainty,
};
use twinstep_identify::{evaluate, residual_at_output, residual_at_sensor};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::NUM_JOINTS;

use crate::failure::{Failure, input, other};
use crate::robot_file::SimulatedRobot;

/// File of the ensemble, in the folder of a diagnosis.
pub const FILE: &str = "residual.safetensors";
/// Unexplained fraction of the residual power above which a network is trained.
const MIN_FRACTION: f64 = 0.05;
/// Least reduction of the closed-loop error on held-out blocks for which it is kept.
const MIN_GAIN: f64 = 0.2;
/// Epochs of a training.
const EPOCHS: usize = 60;
/// Number of networks of the ensemble that is kept.
const MEMBERS: usize = 3;
/// Least reduction of the error by one network for which the others are trained.
const LEAST_OF_ONE: f64 = 0.5 * MIN_GAIN;
/// Highest rate of the networks [Hz]: that of the actuators in simulation.
const MAX_RATE_HZ: f64 = 200.0;

/// Networks that reduce the error on held-out blocks.
pub struct LearnedTorque {
    pub summary: LearnedResidual,
    /// Trained on all rows, on top of the final causes.
    pub ensemble: Ensemble,
}

/// Place at which the missing torque is computed.
#[derive(Clone, Copy)]
enum Tap {
    Sensor,
    Output,
}

/// Settings of `[actuator]` for the networks in the file `ensemble`.
pub fn settings(ensemble: PathBuf) -> ActuatorNetworkConfig {
    ActuatorNetworkConfig { ensemble, mode: NetworkMode::Residual, ..ActuatorNetworkConfig::default() }
}

/// Learns what the causes of a diagnosis leave. Returns `None` if they leave little, if the logs do not show torques, or
/// if the networks do not predict them.
pub fn learn(
    logs: &[Log],
    output: &DiagnosisOutput,
    progress: &mut dyn FnMut(&str) -> bool,
) -> Result<Option<LearnedTorque>, Failure> {
    // Held readings would be learned as a lag.
    let repeats = logs.iter().any(|log| log.measured_hz().is_some());
    if repeats || output.diagnosis.unexplained.fraction < MIN_FRACTION || !output.lacks_torque {
        return Ok(None);
    }
    let masks: Vec<&[bool]> = output.held_out.iter().map(Vec::as_slice).collect();
    let mut best: Option<(f64, Tap, LearnedResidual)> = None;
    for tap in [Tap::Sensor, Tap::Output] {
        let model = &output.extended;
        let Some(data) = data_set(logs, model, tap, &masks, false)? else { continue };
        let before = output.diagnosis.extended;
        let Some(q_before) = before.q_rmse_rad else { continue };
        let of_one = errors_with(logs, model, &trained(&data, 1, progress)?, &masks)?;
        if of_one.q_rmse_rad.is_none_or(|q| q > (1.0 - LEAST_OF_ONE) * q_before) {
            continue;
        }
        let ensemble = trained(&data, MEMBERS, progress)?;
        let after = errors_with(logs, model, &ensemble, &masks)?;
        let Some(q_after) = after.q_rmse_rad else { continue };
        if q_after > (1.0 - MIN_GAIN) * q_before || best.as_ref().is_some_and(|(q, ..)| *q <= q_after) {
            continue;
        }
        let held_out = data_set(logs, model, tap, &masks, true)?;
        best = Some((q_after, tap, summary(&ensemble, &data, held_out.as_ref(), [before, after])));
    }
    let Some((_, tap, summary)) = best else { return Ok(None) };
    let all: Vec<Vec<bool>> = logs.iter().map(|log| vec![false; log.rows()]).collect();
    let all: Vec<&[bool]> = all.iter().map(Vec::as_slice).collect();
    let Some(data) = data_set(logs, &output.extended, tap, &all, false)? else { return Ok(None) };
    Ok(Some(LearnedTorque { summary, ensemble: trained(&data, MEMBERS, progress)? }))
}

/// Returns the torque that `model` lacks at `tap`, in the rows whose mask is `masked`. `None` if the logs do not show it
/// or are too short.
fn data_set(
    logs: &[Log],
    model: &ModelFile,
    tap: Tap,
    masks: &[&[bool]],
    masked: bool,
) -> Result<Option<DataSet>, Failure> {
    let robot = model.robot_model().map_err(other)?;
    let mut lacking = Vec::new();
    for ((index, log), mask) in logs.iter().enumerate().zip(masks) {
        let residual = match tap {
            Tap::Sensor => residual_at_sensor(log, &robot),
            Tap::Output => residual_at_output(log, &robot),
        };
        let Some(residual) = residual.map_err(input)? else { continue };
        let torques: Vec<(String, Vec<f64>)> = residual
            .joints()
            .iter()
            .filter_map(|joint| {
                let cells = residual.tau_measured(joint)?.iter().zip(*mask);
                let kept = cells.map(|(torque, is_masked)| if *is_masked == masked { *torque } else { f64::NAN });
                Some((joint.clone(), kept.collect()))
            })
            .collect();
        let log = residual.with_torques(residual.meta().tau_sensor, &torques);
        let log = if log.meta().rate_hz > MAX_RATE_HZ { log.resampled(MAX_RATE_HZ).map_err(other)? } else { log };
        lacking.push((format!("log {}", index + 1), log));
    }
    let options =
        DataOptions { input: NetworkInput::Torque, target: NetworkTarget::Residual, ..DataOptions::default() };
    match DataSet::with_options(&lacking, options) {
        Ok(data) => Ok(Some(data)),
        // Nothing can be learned from these logs together: too little, or with different rates or sensors.
        Err(
            EnsembleError::TooShort { .. }
            | EnsembleError::NoTorque { .. }
            | EnsembleError::TimeStepMismatch { .. }
            | EnsembleError::SensorMismatch { .. },
        ) => Ok(None),
        Err(error) => Err(other(error)),
    }
}

fn trained(data: &DataSet, members: usize, progress: &mut dyn FnMut(&str) -> bool) -> Result<Ensemble, Failure> {
    // A network must know the joint, because causes that are left are rarely the same at all joints.
    let joint_input = if data.joints.len() == NUM_JOINTS { JointEncoding::Identity } else { JointEncoding::Pooled };
    let options = TrainingOptions { members, hidden: 16, epochs: EPOCHS, joint_input, ..TrainingOptions::default() };
    let training = Training::new(data, options).map_err(other)?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let result = training.run(threads, None, &mut |_| progress("learning the torque that no cause explains"));
    match result.map_err(other)? {
        TrainingResult::Trained(ensemble, _) => Ok(*ensemble),
        TrainingResult::Interrupted(_) => Err(Failure::Interrupted),
    }
}

/// Returns the errors of `model` with the networks on held-out rows.
fn errors_with(
    logs: &[Log],
    model: &ModelFile,
    ensemble: &Ensemble,
    held_out: &[&[bool]],
) -> Result<RmsErrors, Failure> {
    let learned = ActuatorNetworkRobot::new(model, ensemble.clone(), settings(PathBuf::new())).map_err(other)?;
    let SimulatedRobot { robot, mut simulator } = SimulatedRobot::learned(learned)?;
    let (mut torque, mut q) = (Vec::new(), Vec::new());
    for (log, held_out) in logs.iter().zip(held_out) {
        let found = evaluate(log, &robot, &mut simulator, |row| held_out[row]).map_err(other)?;
        torque.extend(found.torque_rmse_nm);
        q.extend(found.q_rmse_rad);
    }
    let rms = |errors: Vec<f64>| {
        let mean = errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64;
        (!errors.is_empty()).then(|| mean.sqrt())
    };
    Ok(RmsErrors { torque_rmse_nm: rms(torque), q_rmse_rad: rms(q) })
}

fn summary(
    ensemble: &Ensemble,
    training: &DataSet,
    held_out: Option<&DataSet>,
    [before, after]: [RmsErrors; 2],
) -> LearnedResidual {
    let largest = |entry: usize| {
        let inputs = training.runs(Split::Training).flat_map(|run| &run.inputs);
        inputs.map(|input| input[entry].abs()).fold(0.0, f64::max)
    };
    let tap = match ensemble.description.tau_sensor {
        TorqueSensor::JointOutput => "output",
        TorqueSensor::MotorCurrent | TorqueSensor::None => "current",
    };
    LearnedResidual {
        ensemble: FILE.to_owned(),
        tap: tap.to_owned(),
        before,
        after,
        max_torque_nm: largest(0),
        max_speed_rad_s: largest(1),
        uncertainty_ratio: held_out
            .map(|held_out| uncertainty(ensemble, held_out) / uncertainty(ensemble, training).max(f64::MIN_POSITIVE)),
    }
}

/// Returns the mean epistemic uncertainty on the rows of a data set [nat].
fn uncertainty(ensemble: &Ensemble, data: &DataSet) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for members in ensemble.predict(data.all_runs()).iter().flatten().filter(|members| !members.is_empty()) {
        let [means, variances] =
            [0, 1].map(|part| members.iter().map(|one| [one.mean, one.variance][part]).collect::<Vec<_>>());
        sum += epistemic_uncertainty(&means, &variances);
        count += 1;
    }
    sum / f64::from(count.max(1))
}

/// Returns the simulated robot of a model with its learned torque.
pub fn simulated(model: &ModelFile, learned: &LearnedTorque) -> Result<SimulatedRobot, Failure> {
    let network = ActuatorNetworkRobot::new(model, learned.ensemble.clone(), settings(FILE.into())).map_err(other)?;
    SimulatedRobot::learned(network)
}
