//! A small trained ensemble and its predictions in `ensemble/golden/`, a reference for other readers of the file
//! format.
//!
//! `UPDATE_GOLDEN=1 cargo test --release --workspace --test it golden_ensemble` trains a new one and writes both files.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twinstep_ensemble::{DataSet, Ensemble, Inference, JointEncoding, Training, TrainingOptions, TrainingResult};
use twinstep_model::{JOINT_NAMES, NUM_JOINTS};
use twinstep_tests::ground_truth_actuator::{DRIVES, Motion};

const ROWS: usize = 60;

/// Inputs of every joint of a robot, and the predictions of every member. Before the first row there is no input.
#[derive(Serialize, Deserialize)]
struct Golden {
    joints: Vec<String>,
    /// Inputs ξ [rad, rad/s], `[row][joint]`.
    errors: Vec<[[f64; 2]; NUM_JOINTS]>,
    /// Mean torque [N·m], `[row][member][joint]`.
    mean: Vec<Vec<[f64; NUM_JOINTS]>>,
    /// Variance of the torque [N²·m²], `[row][member][joint]`.
    variance: Vec<Vec<[f64; NUM_JOINTS]>>,
}

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../ensemble/golden").join(name)
}

fn trained() -> Ensemble {
    let motion = Motion { seconds: 12.0, amplitude: 0.3, hz: [0.3, 6.0], seed: 5 };
    let data = DataSet::new(&[("a saturating actuator".to_owned(), DRIVES[1].logs(motion).measured)]).unwrap();
    let options = TrainingOptions { members: 3, hidden: 8, joint_input: JointEncoding::Kind, epochs: 20, seed: 5 };
    match Training::new(&data, options).unwrap().run(2, None, &mut |_| true).unwrap() {
        TrainingResult::Trained(ensemble, _) => *ensemble,
        TrainingResult::Interrupted(_) => panic!("the callback never interrupts"),
    }
}

/// Returns the predictions of the ensemble for sines with occasional steps.
fn predictions(ensemble: &Ensemble) -> Golden {
    let mut inference = Inference::new(ensemble, 1);
    let joints = JOINT_NAMES.map(str::to_owned).to_vec();
    let mut golden = Golden { joints, errors: Vec::new(), mean: Vec::new(), variance: Vec::new() };
    for row in 0..ROWS {
        let errors = std::array::from_fn(|joint| {
            let phase = 0.2 * row as f64 + joint as f64;
            let jump = if (row + 7 * joint) % 31 < 4 { 0.25 } else { 0.0 };
            [0.15 * phase.sin() + jump, 3.0 * phase.cos()]
        });
        inference.step(&[errors]);
        let members = || (0..ensemble.description.members).map(|member| inference.predictions(0, member));
        golden.mean.push(members().map(|gaussians| gaussians.map(|gaussian| gaussian.mean)).collect());
        golden.variance.push(members().map(|gaussians| gaussians.map(|gaussian| gaussian.variance)).collect());
        golden.errors.push(errors);
    }
    golden
}

#[test]
fn golden_ensemble_reproduces_the_stored_predictions() {
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        let ensemble = trained();
        std::fs::create_dir_all(path("")).unwrap();
        ensemble.write(path("actuators.safetensors")).unwrap();
        std::fs::write(path("expected.json"), serde_json::to_string(&predictions(&ensemble)).unwrap()).unwrap();
    }
    let written: Golden = serde_json::from_slice(&std::fs::read(path("expected.json")).unwrap()).unwrap();
    let found = predictions(&Ensemble::read(path("actuators.safetensors")).unwrap());
    for (written, found) in [(written.mean, found.mean), (written.variance, found.variance)] {
        let [written, found] = [written, found].map(|rows| rows.concat().concat());
        assert_eq!(written.len(), ROWS * 3 * NUM_JOINTS);
        // The tolerance is for the rounding of the text; the kernel is bitwise reproducible.
        assert!(written.iter().zip(&found).all(|(one, other)| (one - other).abs() < 1e-9));
    }
}
