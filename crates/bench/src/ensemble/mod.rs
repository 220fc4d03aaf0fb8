//! Actuator networks: speed of inference and training compared with baselines, and of robots simulated with them.

mod in_loop;
mod inference;
mod torch;
mod training;

use std::path::Path;

use twinstep_ensemble::{
    Ensemble, EnsembleMetadata, JointEncoding, NetworkInput, NetworkTarget, Normaliser, Normalisers,
};
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, go2};

use crate::Measurement;
use crate::error::{BenchError, Interrupted};

/// Number of members in U2E.
const MEMBERS: usize = 6;
/// Number of hidden units in U2E.
const HIDDEN: usize = 32;

/// Measures inference, training and simulation with an ensemble.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = inference::measure(python, window_s, interrupted)?;
    rows.extend(training::measure(python, window_s, interrupted)?);
    rows.extend(in_loop::measure(window_s, interrupted)?);
    Ok(rows)
}

/// Returns an ensemble that computes the PD law of a Go2: as fast as any other of its size, and robots keep standing.
fn ensemble(members: usize) -> Ensemble {
    let (control, scale) = (go2().control, |std| Normaliser { mean: 0.0, std });
    Ensemble::linear_pd(EnsembleMetadata {
        members,
        hidden: HIDDEN,
        dt: control.actuator_dt(),
        joints: JOINT_NAMES.map(str::to_owned).to_vec(),
        joint_input: JointEncoding::Pooled,
        input: NetworkInput::default(),
        target: NetworkTarget::default(),
        scales: Normalisers { inputs: [scale(0.2), scale(4.0)], torque: scale(8.0) },
        tau_sensor: TorqueSensor::MotorCurrent,
        gains: (0..JOINT_NAMES.len()).map(|joint| [control.kp[joint], control.kd[joint]]).collect(),
        variance_scale: 1.0,
        data_hash: String::new(),
        seed: 1,
    })
}
