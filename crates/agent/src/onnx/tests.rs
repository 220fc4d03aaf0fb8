//! Networks as exporters write them, with the outputs of onnxruntime.
//!
//! `golden/make.py` wrote the files: from both exporters of PyTorch, operator sets 11 to 20.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::*;

type Arrays = BTreeMap<String, Vec<f32>>;

/// Inputs and outputs of a step, by name.
#[derive(serde::Deserialize)]
struct Step {
    inputs: Arrays,
    outputs: Arrays,
}

fn golden() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden");
    let files = std::fs::read_dir(folder).expect("the golden files").map(|file| file.expect("a file").path());
    files.filter(|path| path.extension().is_some_and(|end| end == "onnx")).collect()
}

/// Returns the largest difference between the outputs of a network and those in the file beside it.
fn largest_difference(path: &Path) -> f32 {
    let network = OnnxNetwork::read(path).unwrap_or_else(|error| panic!("{error}"));
    let text = std::fs::read_to_string(path.with_extension("json")).expect("the expected outputs");
    let steps: Vec<Step> = serde_json::from_str(&text).expect("the expected outputs");
    let mut largest = 0.0f32;
    for Step { inputs, outputs } in steps {
        let inputs: Vec<&[f32]> = network.inputs().iter().map(|port| &inputs[&port.name][..]).collect();
        let found = network.run(&inputs).expect("a step");
        for (port, found) in network.outputs().iter().zip(found) {
            assert_eq!(found.len(), outputs[&port.name].len(), "{}: `{}`", path.display(), port.name);
            let differences = found.iter().zip(&outputs[&port.name]).map(|(one, other)| (one - other).abs());
            largest = differences.fold(largest, f32::max);
        }
    }
    largest
}

#[test]
fn outputs_are_those_of_onnxruntime() {
    let files = golden();
    assert!(files.len() >= 18, "{} networks", files.len());
    for path in files {
        let difference = largest_difference(&path);
        assert!(difference < 1e-5, "{}: {difference}", path.display());
    }
}

#[test]
fn state_of_a_recurrent_network_has_its_shape() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/lstm_script.onnx");
    let network = OnnxNetwork::read(path).expect("a network");
    let shapes: Vec<_> = network.inputs().iter().map(|port| (port.name.as_str(), port.shape.clone())).collect();
    assert_eq!(shapes, [("obs", vec![1, 9]), ("h_in", vec![2, 1, 5]), ("c_in", vec![2, 1, 5])]);
    assert_eq!(network.outputs()[1].shape, [2, 1, 5]);
}
