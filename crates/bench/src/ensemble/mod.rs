//! Actuator networks: how fast networks answer and learn beside others, and robots that they actuator.

mod in_loop;
mod inference;
mod torch;
mod training;

use std::path::Path;

use twinstep_ensemble::{Ensemble, EnsembleMetadata, JointEncoding, Normaliser, Normalisers};
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, go2};

use crate::Measurement;
use crate::error::{BenchError, Interrupted};

/// U2E's sizes.
const MEMBERS: usize = 6;
const HIDDEN: usize = 32;

/// Every number of the ensemble.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = inference::measure(python, window_s, interrupted)?;
    rows.extend(training::measure(python, window_s, interrupted)?);
    rows.extend(in_loop::measure(window_s, interrupted)?);
    Ok(rows)
}

/// An ensemble that actuators a Go2 by its gains: as fast as any other of its size, and robots stay on their feet.
fn ensemble(members: usize) -> Ensemble {
    let (control, scale) = (go2().control, |deviation| Normaliser { mean: 0.0, std: deviation });
    Ensemble::linear_pd(EnsembleMetadata {
        members,
        hidden: HIDDEN,
        dt: control.actuator_dt(),
        joints: JOINT_NAMES.map(str::to_owned).to_vec(),
        joint_input: JointEncoding::Pooled,
        scales: Normalisers { errors: [scale(0.2), scale(4.0)], torque: scale(8.0) },
        tau_sensor: TorqueSensor::MotorCurrent,
        gains: vec![[control.kp, control.kd]; JOINT_NAMES.len()],
        variance_scale: 1.0,
        data_hash: String::new(),
        seed: 1,
    })
}
