//! Compares the outputs of ONNX files with expected ones: for each FILE.onnx, FILE.json has inputs and outputs by name.
//!
//! `python crates/agent/golden/nodes.py DIR` writes the tests of the ONNX specification in this form, and
//! `cargo run --release -p twinstep-agent --example onnx_outputs DIR/*.onnx` prints those that differ,
//! and the time of an evaluation.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use twinstep_agent::OnnxNetwork;

type Arrays = BTreeMap<String, Vec<f32>>;

/// Number of evaluations whose time is measured.
const RUNS: u32 = 200;

#[derive(serde::Deserialize)]
struct Step {
    inputs: Arrays,
    outputs: Arrays,
}

fn main() {
    let (mut equal, mut other, mut refused) = (0, 0, 0);
    for path in std::env::args().skip(1).map(PathBuf::from) {
        match largest_difference(&path) {
            Ok(difference) if difference < 1e-5 => equal += 1,
            Ok(difference) => {
                other += 1;
                println!("{}: {difference:e}", path.display());
            }
            Err(error) => {
                refused += 1;
                println!("{error}");
            }
        }
    }
    println!("{equal} equal to 1e-5, {other} different, {refused} refused");
}

fn largest_difference(path: &Path) -> Result<f32, Box<dyn std::error::Error>> {
    let network = OnnxNetwork::read(path)?;
    let steps: Vec<Step> = serde_json::from_str(&std::fs::read_to_string(path.with_extension("json"))?)?;
    let mut largest = 0.0f32;
    let zeros: Vec<Vec<f32>> = network.inputs().iter().map(|port| vec![0.0; port.len()]).collect();
    let inputs: Vec<&[f32]> = zeros.iter().map(Vec::as_slice).collect();
    let since = Instant::now();
    (0..RUNS).try_for_each(|_| network.run(&inputs).map(drop))?;
    let micros = 1e6 * since.elapsed().as_secs_f64() / f64::from(RUNS);
    println!("{}: {micros:.1} µs", path.display());
    for Step { inputs, outputs } in steps {
        let inputs: Vec<&[f32]> = network.inputs().iter().map(|port| &inputs[&port.name][..]).collect();
        for (port, found) in network.outputs().iter().zip(network.run(&inputs)?) {
            let expected = &outputs[&port.name];
            if found.len() != expected.len() {
                return Err(format!("{}: `{}` has {} numbers", path.display(), port.name, found.len()).into());
            }
            let differences = found.iter().zip(expected).map(|(one, other)| (one - other).abs() / (1.0 + other.abs()));
            // NaN is a difference.
            largest = differences.fold(largest, |a, b| if b <= a { a } else { b });
        }
    }
    Ok(largest)
}
