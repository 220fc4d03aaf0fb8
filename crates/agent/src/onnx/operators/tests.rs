//! Tests of single operators, with results that are known without an evaluator.

use std::collections::HashMap;

use super::*;
use crate::onnx::graph::Attribute;

fn tensor(shape: &[usize], values: &[f32]) -> Tensor {
    Tensor::floats(shape.to_vec(), values.to_vec()).expect("a tensor")
}

fn integers(values: &[i64]) -> Tensor {
    Tensor::integers(vec![values.len()], values.to_vec()).expect("a tensor")
}

fn node(operator: &str, attributes: &[(&str, i64)], outputs: usize) -> Node {
    let attribute = |value: &i64| Attribute { integer: Some(*value), integers: vec![*value], ..Attribute::default() };
    let attributes: HashMap<_, _> =
        attributes.iter().map(|(name, value)| ((*name).to_owned(), attribute(value))).collect();
    let outputs = (0..outputs).map(|index| index.to_string()).collect();
    Node { operator: operator.to_owned(), attributes, outputs, ..Node::default() }
}

fn results(operator: &str, attributes: &[(&str, i64)], inputs: &[&Tensor], outputs: usize) -> Vec<Tensor> {
    let inputs: Vec<_> = inputs.iter().map(|input| Some(*input)).collect();
    evaluate(&node(operator, attributes, outputs), &inputs).unwrap_or_else(|problem| panic!("{operator} {problem}"))
}

fn result(operator: &str, attributes: &[(&str, i64)], inputs: &[&Tensor]) -> Tensor {
    results(operator, attributes, inputs, 1).swap_remove(0)
}

#[test]
fn gemm_is_that_of_the_specification() {
    let (x, c) = (tensor(&[1, 2], &[1.0, 2.0]), tensor(&[3], &[10.0, 20.0, 30.0]));
    let b = tensor(&[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    let transposed = tensor(&[3, 2], &[1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
    let expected = tensor(&[1, 3], &[19.0, 32.0, 45.0]);
    assert_eq!(result("Gemm", &[], &[&x, &b, &c]), expected);
    assert_eq!(result("Gemm", &[("transB", 1)], &[&x, &transposed, &c]), expected);
    assert_eq!(result("Gemm", &[("transA", 1)], &[&tensor(&[2, 1], &[1.0, 2.0]), &b, &c]), expected);
    assert_eq!(result("MatMul", &[], &[&x, &b]), tensor(&[1, 3], &[9.0, 12.0, 15.0]));
    let many = tensor(&[2, 1, 2], &[1.0, 2.0, 0.0, 1.0]);
    assert_eq!(result("MatMul", &[], &[&many, &b]), tensor(&[2, 1, 3], &[9.0, 12.0, 15.0, 4.0, 5.0, 6.0]));
}

#[test]
fn activations_have_their_closed_forms() {
    let x = tensor(&[1, 3], &[-1.0, 0.0, 2.0]);
    let e = std::f32::consts::E;
    for (operator, expected) in [
        ("Relu", [0.0, 0.0, 2.0]),
        ("Elu", [1.0 / e - 1.0, 0.0, 2.0]),
        ("LeakyRelu", [-0.01, 0.0, 2.0]),
        ("Selu", [1.050_701 * 1.673_263_2 * (1.0 / e - 1.0), 0.0, 2.101_402]),
        ("Tanh", [-0.761_594_2, 0.0, 0.964_027_6]),
        ("Sigmoid", [0.268_941_43, 0.5, 0.880_797_1]),
        ("Softplus", [0.313_261_7, std::f32::consts::LN_2, 2.126_928]),
        ("HardSigmoid", [0.3, 0.5, 0.9]),
        ("Erf", [-0.842_700_8, 0.0, 0.995_322_3]),
        ("Gelu", [-0.158_655_26, 0.0, 1.954_499_7]),
        ("HardSwish", [-1.0 / 3.0, 0.0, 5.0 / 3.0]),
    ] {
        let found = result(operator, &[], &[&x]);
        let near =
            found.as_floats().expect("floats").iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-6);
        assert!(near, "{operator}: {found:?}");
    }
}

#[test]
fn a_gaussian_head_is_split_into_mean_and_deviation() {
    let x = tensor(&[1, 4], &[1.0, 2.0, 3.0, 4.0]);
    assert_eq!(
        results("Split", &[("axis", -1)], &[&x], 2),
        [tensor(&[1, 2], &[1.0, 2.0]), tensor(&[1, 2], &[3.0, 4.0])]
    );
    // As `chunk` of PyTorch: half of a length that the graph computes.
    let len = result("Gather", &[], &[&result("Shape", &[], &[&x]), &integers(&[1])]);
    let half = result("Div", &[], &[&len, &integers(&[2])]);
    assert_eq!(half, integers(&[2]));
    assert_eq!(result("Slice", &[], &[&x, &integers(&[0]), &half, &integers(&[1])]), tensor(&[1, 2], &[1.0, 2.0]));
}

#[test]
fn a_part_of_the_input_is_cut_normalised_and_appended() {
    // As HIMLoco does with its velocity estimate and latent vector.
    let x = tensor(&[1, 4], &[9.0, 3.0, 4.0, 7.0]);
    let part = result("Slice", &[], &[&x, &integers(&[1]), &integers(&[-1]), &integers(&[1])]);
    let norm = result("ReduceL2", &[("axes", -1)], &[&part]);
    assert_eq!(norm, tensor(&[1, 1], &[5.0]));
    let expanded = result("Expand", &[], &[&norm, &result("Shape", &[], &[&part])]);
    let unit = result("Div", &[], &[&part, &expanded]);
    let all = result("Concat", &[("axis", -1)], &[&x, &unit]);
    assert_eq!(all, tensor(&[1, 6], &[9.0, 3.0, 4.0, 7.0, 0.6, 0.8]));
}

#[test]
fn shapes_follow_the_specification() {
    let x = tensor(&[1, 2, 2], &[1.0, 2.0, 3.0, 4.0]);
    assert_eq!(result("Flatten", &[], &[&x]).shape, [1, 4]);
    assert_eq!(result("Reshape", &[], &[&x, &integers(&[0, -1])]).shape, [1, 4]);
    assert_eq!(result("Squeeze", &[("axes", 0)], &[&x]).shape, [2, 2]);
    assert_eq!(result("Unsqueeze", &[("axes", -1)], &[&x]).shape, [1, 2, 2, 1]);
    assert_eq!(result("Transpose", &[], &[&x]), tensor(&[2, 2, 1], &[1.0, 3.0, 2.0, 4.0]));
    assert_eq!(result("Tile", &[], &[&integers(&[1, 2]), &integers(&[2])]), integers(&[1, 2, 1, 2]));
    let backwards = [&integers(&[-1]), &integers(&[i64::MIN]), &integers(&[2]), &integers(&[-1])];
    let reversed = result("Slice", &[], &[&[&x][..], &backwards[..]].concat());
    assert_eq!(reversed, tensor(&[1, 2, 2], &[2.0, 1.0, 4.0, 3.0]));
    let bounds = [tensor(&[], &[1.5]), tensor(&[], &[3.5])];
    assert_eq!(result("Clip", &[], &[&x, &bounds[0], &bounds[1]]), tensor(&[1, 2, 2], &[1.5, 2.0, 3.0, 3.5]));
}

#[test]
fn invalid_operations_are_errors() {
    let (x, y) = (tensor(&[1, 2], &[1.0, 2.0]), tensor(&[1, 3], &[1.0; 3]));
    let zero = integers(&[0]);
    for (operator, inputs) in [
        ("Add", vec![Some(&x), Some(&y)]),
        ("MatMul", vec![Some(&x), Some(&y)]),
        ("Add", vec![Some(&x), None]),
        ("Reshape", vec![Some(&x), Some(&y)]),
        ("Relu", Vec::new()),
        ("LSTM", vec![Some(&x)]),
        ("Loop", vec![Some(&x)]),
        ("Div", vec![Some(&zero), Some(&zero)]),
        ("Gather", vec![Some(&x), Some(&x)]),
        ("Split", vec![Some(&x), Some(&zero)]),
        ("Conv", vec![Some(&x), Some(&y)]),
        ("LayerNormalization", vec![Some(&x), Some(&y)]),
    ] {
        assert!(evaluate(&node(operator, &[], 1), &inputs).is_err(), "{operator}");
    }
    let shape = integers(&[i64::MAX, i64::MAX]);
    assert!(evaluate(&node("Expand", &[], 1), &[Some(&x), Some(&shape)]).is_err());
    assert!(evaluate(&node("ConstantOfShape", &[], 1), &[Some(&shape)]).is_err());
    assert!(evaluate(&node("Tile", &[], 1), &[Some(&x), Some(&shape)]).is_err());
    assert!(evaluate(&node("Reshape", &[], 1), &[Some(&x), Some(&integers(&[-1, 0, 0, 0]))]).is_err());
    assert!(evaluate(&node("Concat", &[("axis", 7)], 1), &[Some(&x)]).is_err());
}
