//! Networks of policies compared with burn and onnxruntime.

use std::path::Path;
use std::process::Command;

use burn::tensor::{Device, Tensor, TensorData};
use rand::RngExt;
use twinstep_envs::base_spec;
use twinstep_model::{go2, stream};
use twinstep_policy::{Activations, Mlp, Network, Normaliser, Policy, PolicyOrigin, PolicyRunner};
use twinstep_tests::fuzz::weights_examples::{header_and_data, with_header};
use twinstep_tests::python::python;

fn example() -> (Policy, Vec<f32>) {
    let mut random = stream(11, "policy", 0);
    let mut values = |len: usize| -> Vec<f32> { (0..len).map(|_| 4.0 * random.random::<f32>() - 2.0).collect() };
    let obs = values(100 * 45);
    let mut normaliser = Normaliser::identity(45);
    normaliser.update(&obs);
    let mut actor = Mlp::orthogonal(&[45, 128, 64, 12], 1.0, &mut stream(11, "actor", 0));
    for index in 0..3 {
        let (weight, bias) = actor.layer(index);
        actor.set_layer(index, &weight, &values(bias.len()));
    }
    let spec = base_spec("walk", &go2(), Vec::new(), 20.0);
    (Policy { spec, normaliser, actor, log_std: vec![-1.0; 12] }, obs)
}

/// Returns a tensor whose gradient is computed.
fn parameter<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), device).require_grad()
}

#[test]
fn outputs_and_gradients_are_those_of_burn() {
    let (Policy { actor, .. }, obs) = example();
    let (rows, device) = (100, Device::flex().autodiff());
    let factors: Vec<f32> = (0..rows * 12).map(|index| (index as f32).sin()).collect();

    let layers = actor.layers();
    let parameters: Vec<(Tensor<2>, Tensor<1>)> = layers
        .iter()
        .enumerate()
        .map(|(index, layer)| {
            let (weight, bias) = actor.layer(index);
            let weight = parameter(weight, [layer.inputs, layer.outputs], &device);
            (weight, parameter(bias, [layer.outputs], &device))
        })
        .collect();
    let mut x: Tensor<2> = Tensor::from_data(TensorData::new(obs.clone(), [rows, 45]), &device);
    for (index, (weight, bias)) in parameters.iter().enumerate() {
        x = x.matmul(weight.clone()) + bias.clone().unsqueeze();
        if index + 1 < layers.len() {
            x = burn::tensor::activation::relu(x);
        }
    }
    let outputs: Vec<f32> = x.clone().into_data().try_into_vec().unwrap();
    let factor_tensor: Tensor<2> = Tensor::from_data(TensorData::new(factors.clone(), [rows, 12]), &device);
    let gradients = (x * factor_tensor).sum().backward();

    let network = Network::new(&actor);
    let mut activations = Activations::new(&actor, rows);
    for (row, obs) in obs.chunks_exact(45).enumerate() {
        activations.input(row)[..45].copy_from_slice(obs);
    }
    network.forward(&mut activations, rows);
    for row in 0..rows {
        for output in 0..12 {
            let difference = activations.output(row)[output] - outputs[12 * row + output];
            assert!(difference.abs() < 1e-4, "row {row}, output {output}: {difference}");
        }
        activations.output_gradient(row)[..12].copy_from_slice(&factors[12 * row..][..12]);
    }
    let mut gradient = actor.clone();
    gradient.parameters.fill(0.0);
    network.backward(&mut activations, rows, &mut gradient.parameters);
    for (index, (weight, bias)) in parameters.iter().enumerate() {
        let (own_weight, own_bias) = gradient.layer(index);
        let theirs: Vec<f32> = weight.grad(&gradients).unwrap().into_data().try_into_vec().unwrap();
        let bias: Vec<f32> = bias.grad(&gradients).unwrap().into_data().try_into_vec().unwrap();
        for (own, other) in own_weight.iter().chain(&own_bias).zip(theirs.iter().chain(&bias)) {
            // Sums of 100 products in single precision, in another order.
            assert!((own - other).abs() < 1e-3 * (1.0 + other.abs()), "layer {index}: {own} {other}");
        }
    }
}

#[test]
fn policy_is_read_as_it_was_written() {
    let (policy, obs) = example();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.safetensors");
    let origin = PolicyOrigin { command: "twinstep train".to_owned(), seed: 3, ..PolicyOrigin::default() };
    policy.write(&path, origin.clone()).unwrap();
    let (read, header) = Policy::read(&path).unwrap();
    assert_eq!((header.origin, read.spec.hash()), (origin, policy.spec.hash()));
    let actions = |policy: &Policy| {
        let mut actions = vec![0.0; 100 * 12];
        PolicyRunner::new(policy).run(&obs, &mut actions);
        actions
    };
    assert_eq!(actions(&read), actions(&policy));
}

#[test]
fn broken_policy_files_are_rejected_with_the_reason() {
    let (policy, _) = example();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.safetensors");
    let error = || Policy::read(&path).unwrap_err().to_string().replace(&path.display().to_string(), "FILE");
    assert_eq!(error(), "cannot read FILE: No such file or directory (os error 2)");
    std::fs::write(&path, b"nothing").unwrap();
    assert!(error().starts_with("FILE is not a safetensors file: "), "{}", error());
    let nan = Policy { log_std: vec![f32::NAN; 12], ..policy.clone() };
    nan.write(&path, PolicyOrigin::default()).unwrap();
    assert_eq!(error(), "FILE has a number in `log_std` that is not finite");
    let short = Policy { log_std: vec![0.0; 11], ..policy.clone() };
    short.write(&path, PolicyOrigin::default()).unwrap();
    assert_eq!(error(), "FILE has `log_std` with dimensions [11] instead of [12]");
    // A file of some kilobytes that claims a network of 340 GB.
    policy.write(&path, PolicyOrigin::default()).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let (header, data) = header_and_data(&bytes);
    let claim = format!("[45,{}12]", "65000,".repeat(20));
    let own = format!("{:?}", policy.actor.sizes()).replace(' ', "");
    let large = String::from_utf8(header.to_vec()).unwrap().replace(&own, &claim);
    assert_ne!(large.as_bytes(), header);
    std::fs::write(&path, with_header(large.as_bytes(), data)).unwrap();
    assert!(error().contains("`actor.0.weight` with dimensions"), "{}", error());
    let other = Policy { actor: Mlp::zeros(&[44, 8, 12]), ..policy };
    other.write(&path, PolicyOrigin::default()).unwrap();
    assert_eq!(error(), "FILE has `actor_sizes` = [44, 8, 12], which does not fit its spec");
}

const ONNX_SCRIPT: &str = r#"
import json, sys
import numpy as np, onnx, onnxruntime
onnx.checker.check_model(onnx.load(sys.argv[1]), full_check=True)
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
obs = np.array(json.load(sys.stdin), np.float32).reshape(-1, 45)
name = session.get_inputs()[0].name
together = session.run(None, {name: obs})[0]
single = np.concatenate([session.run(None, {name: row[None]})[0] for row in obs])
assert np.allclose(together, single, atol=1e-5)
json.dump({"inputs": [i.name for i in session.get_inputs()], "actions": single.ravel().tolist()}, sys.stdout)
"#;

#[test]
fn onnx_policy_in_onnxruntime_gives_the_same_actions() {
    let target = Path::new(env!("CARGO_BIN_EXE_faults")).ancestors().nth(2).unwrap();
    let Some(python) = python(target).unwrap() else { return };
    let (policy, obs) = example();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.onnx");
    policy.write_onnx(&path).unwrap();
    let input = folder.path().join("obs.json");
    std::fs::write(&input, serde_json::to_string(&obs).unwrap()).unwrap();
    let mut command = Command::new(python);
    command.args(["-c", ONNX_SCRIPT]).arg(&path).stdin(std::fs::File::open(&input).unwrap());
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["inputs"], serde_json::json!(["obs"]));
    let mut actions = vec![0.0; 100 * 12];
    PolicyRunner::new(&policy).run(&obs, &mut actions);
    for (action, other) in actions.iter().zip(answer["actions"].as_array().unwrap()) {
        assert!((f64::from(*action) - other.as_f64().unwrap()).abs() < 1e-4, "{action} {other}");
    }
}
