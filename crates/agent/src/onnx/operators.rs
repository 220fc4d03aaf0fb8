//! Operators of ONNX that networks of policies consist of.

use crate::onnx::graph::{FLOAT, INT64, Node};
use crate::onnx::tensor::{Data, Tensor, broadcast, len};

/// Names of the supported operators.
pub const SUPPORTED: [&str; 37] = [
    "Abs",
    "Add",
    "Cast",
    "Clip",
    "Concat",
    "Constant",
    "Div",
    "Dropout",
    "Elu",
    "Exp",
    "Expand",
    "Flatten",
    "Gemm",
    "HardSigmoid",
    "Identity",
    "LeakyRelu",
    "MatMul",
    "Max",
    "Min",
    "Mul",
    "Neg",
    "Pow",
    "ReduceL2",
    "ReduceMean",
    "ReduceSum",
    "Relu",
    "Reshape",
    "Selu",
    "Shape",
    "Sigmoid",
    "Slice",
    "Softplus",
    "Sqrt",
    "Squeeze",
    "Sub",
    "Tanh",
    "Unsqueeze",
];

/// Inputs of an operation; `None` for an optional one that is left out.
type Inputs<'a> = [Option<&'a Tensor>];

/// Returns the first output of an operation. The error continues a sentence with the name of the operator.
pub fn evaluate(node: &Node, inputs: &Inputs) -> Result<Tensor, String> {
    let float = |name: &str, default: f32| node.attributes.get(name).and_then(|one| one.float).unwrap_or(default);
    let integer = |name: &str, default: i64| node.attributes.get(name).and_then(|one| one.integer).unwrap_or(default);
    let x = || input(inputs, 0);
    let each = |f: &dyn Fn(f32) -> f32| {
        let x = x()?;
        Tensor::floats(x.shape.clone(), x.as_floats()?.iter().map(|value| f(*value)).collect())
    };
    let pair = |f: fn(f32, f32) -> f32| broadcast(x()?, input(inputs, 1)?, f);
    match node.operator.as_str() {
        "Identity" | "Dropout" => Ok(x()?.clone()),
        "Constant" => constant(node),
        "Add" => pair(|a, b| a + b),
        "Sub" => pair(|a, b| a - b),
        "Mul" => pair(|a, b| a * b),
        "Div" => pair(|a, b| a / b),
        "Pow" => pair(f32::powf),
        "Max" => pair(f32::max),
        "Min" => pair(f32::min),
        "Abs" => each(&f32::abs),
        "Exp" => each(&f32::exp),
        "Neg" => each(&|x| -x),
        "Sqrt" => each(&f32::sqrt),
        "Tanh" => each(&f32::tanh),
        "Relu" => each(&|x| x.max(0.0)),
        "Sigmoid" => each(&|x| 1.0 / (1.0 + (-x).exp())),
        "HardSigmoid" => {
            let (alpha, beta) = (float("alpha", 0.2), float("beta", 0.5));
            each(&|x| (alpha * x + beta).clamp(0.0, 1.0))
        }
        // ln(1 + eˣ) without overflow.
        "Softplus" => each(&|x| x.max(0.0) + (-x.abs()).exp().ln_1p()),
        "LeakyRelu" => {
            let alpha = float("alpha", 0.01);
            each(&|x| if x < 0.0 { alpha * x } else { x })
        }
        "Elu" => {
            let alpha = float("alpha", 1.0);
            each(&|x| if x < 0.0 { alpha * x.exp_m1() } else { x })
        }
        "Selu" => {
            let (alpha, gamma) = (float("alpha", 1.673_263_2), float("gamma", 1.050_701));
            each(&|x| gamma * if x < 0.0 { alpha * x.exp_m1() } else { x })
        }
        "Clip" => {
            let bound = |index: usize, name: &str, default: f32| match inputs.get(index).copied().flatten() {
                Some(bound) => bound.as_floats()?.first().copied().ok_or_else(|| format!("an empty `{name}`")),
                None => Ok(float(name, default)),
            };
            let (low, high) = (bound(1, "min", f32::NEG_INFINITY)?, bound(2, "max", f32::INFINITY)?);
            each(&|x| x.max(low).min(high))
        }
        "Gemm" => gemm(
            inputs,
            [float("alpha", 1.0), float("beta", 1.0)],
            ["transA", "transB"].map(|key| integer(key, 0) != 0),
        ),
        "MatMul" => product(x()?, input(inputs, 1)?, [false, false]),
        "Concat" => concat(inputs, integer("axis", 0)),
        "Slice" => slice(node, inputs),
        "ReduceL2" => reduce(node, inputs, &|values| values.iter().map(|x| x * x).sum::<f32>().sqrt()),
        "ReduceSum" => reduce(node, inputs, &|values| values.iter().sum()),
        "ReduceMean" => reduce(node, inputs, &|values| values.iter().sum::<f32>() / values.len() as f32),
        "Cast" => cast(x()?, integer("to", 0)),
        "Shape" => {
            let shape: Vec<i64> = x()?.shape.iter().map(|len| *len as i64).collect();
            Tensor::integers(vec![shape.len()], shape)
        }
        "Expand" => {
            let shape = positive(input(inputs, 1)?.as_integers()?)?;
            let zeros = Tensor::floats(shape.clone(), vec![0.0; len(&shape)?])?;
            broadcast(x()?, &zeros, |x, _| x)
        }
        "Flatten" => {
            let (x, axis) = (x()?, integer("axis", 1));
            let axis = if axis == x.shape.len() as i64 { x.shape.len() } else { x.axis(axis)? };
            x.reshaped(vec![x.shape[..axis].iter().product(), x.shape[axis..].iter().product()])
        }
        "Reshape" => reshape(x()?, input(inputs, 1)?.as_integers()?),
        "Squeeze" => {
            let (x, axes) = (x()?, axes(node, inputs)?);
            let removed = axes.iter().map(|axis| x.axis(*axis)).collect::<Result<Vec<_>, _>>()?;
            let is_kept = |(axis, len): &(usize, &usize)| {
                if removed.is_empty() { **len != 1 } else { !removed.contains(axis) }
            };
            x.reshaped(x.shape.iter().enumerate().filter(is_kept).map(|(_, len)| *len).collect())
        }
        "Unsqueeze" => {
            let (x, mut axes) = (x()?, axes(node, inputs)?);
            let rank = (x.shape.len() + axes.len()) as i64;
            axes.iter_mut().filter(|axis| **axis < 0).for_each(|axis| *axis += rank);
            axes.sort_unstable();
            let mut shape = x.shape.clone();
            for axis in axes {
                let position = usize::try_from(axis).ok().filter(|position| *position <= shape.len());
                shape.insert(position.ok_or("an axis out of range")?, 1);
            }
            x.reshaped(shape)
        }
        _ => Err(format!("is not supported; supported are {}", SUPPORTED.join(", "))),
    }
}

fn input<'a>(inputs: &Inputs<'a>, index: usize) -> Result<&'a Tensor, String> {
    inputs.get(index).copied().flatten().ok_or_else(|| format!("has no input {index}"))
}

fn constant(node: &Node) -> Result<Tensor, String> {
    let attribute = |name: &str| node.attributes.get(name);
    if let Some(tensor) = attribute("value").and_then(|value| value.tensor.clone()) {
        return Ok(tensor);
    }
    if let Some(value) = attribute("value_float").and_then(|value| value.float) {
        return Tensor::floats(Vec::new(), vec![value]);
    }
    if let Some(value) = attribute("value_int").and_then(|value| value.integer) {
        return Tensor::integers(Vec::new(), vec![value]);
    }
    if let Some(values) = attribute("value_floats") {
        return Tensor::floats(vec![values.floats.len()], values.floats.clone());
    }
    let values = attribute("value_ints").ok_or("has no value that is supported")?;
    Tensor::integers(vec![values.integers.len()], values.integers.clone())
}

/// Returns the matrix product of two matrices, which may be transposed first.
fn product(a: &Tensor, b: &Tensor, transposed: [bool; 2]) -> Result<Tensor, String> {
    let ([a_rows, a_columns], [b_rows, b_columns]) = (matrix(a)?, matrix(b)?);
    let [rows, inner] = if transposed[0] { [a_columns, a_rows] } else { [a_rows, a_columns] };
    let [other, columns] = if transposed[1] { [b_columns, b_rows] } else { [b_rows, b_columns] };
    if inner != other {
        return Err(format!("the dimensions {:?} and {:?} do not fit", a.shape, b.shape));
    }
    let (a, b) = (a.as_floats()?, b.as_floats()?);
    let mut values = vec![0.0; len(&[rows, columns])?];
    for row in 0..rows {
        let factor = |k: usize| if transposed[0] { a[k * a_columns + row] } else { a[row * a_columns + k] };
        let results = &mut values[row * columns..][..columns];
        // Weights are read in the order in which they are stored.
        if transposed[1] {
            for (result, weights) in results.iter_mut().zip(b.chunks_exact(b_columns.max(1))) {
                *result = weights.iter().enumerate().map(|(k, weight)| factor(k) * weight).sum();
            }
        } else {
            for (k, weights) in b.chunks_exact(columns.max(1)).enumerate() {
                let factor = factor(k);
                for (result, weight) in results.iter_mut().zip(weights) {
                    *result += factor * weight;
                }
            }
        }
    }
    Tensor::floats(vec![rows, columns], values)
}

fn matrix(tensor: &Tensor) -> Result<[usize; 2], String> {
    tensor.shape[..].try_into().map_err(|_| format!("the dimensions {:?}; a matrix is expected", tensor.shape))
}

/// `alpha · a · b + beta · c`.
fn gemm(inputs: &Inputs, [alpha, beta]: [f32; 2], transposed: [bool; 2]) -> Result<Tensor, String> {
    let mut result = product(input(inputs, 0)?, input(inputs, 1)?, transposed)?;
    if let Data::Float(values) = &mut result.data {
        for value in values {
            *value *= alpha;
        }
    }
    match inputs.get(2).copied().flatten() {
        Some(c) => broadcast(&result, c, |product, c| product + beta * c),
        None => Ok(result),
    }
}

fn concat(inputs: &Inputs, axis: i64) -> Result<Tensor, String> {
    let first = input(inputs, 0)?;
    let axis = first.axis(axis)?;
    let mut shape = first.shape.clone();
    shape[axis] = 0;
    let all = (0..inputs.len()).map(|index| input(inputs, index)).collect::<Result<Vec<_>, _>>()?;
    for tensor in &all {
        let fits = tensor.shape.len() == shape.len()
            && tensor
                .shape
                .iter()
                .zip(&first.shape)
                .enumerate()
                .all(|(index, (one, other))| index == axis || one == other);
        if !fits {
            return Err(format!("the dimensions {:?} and {:?} do not fit", first.shape, tensor.shape));
        }
        shape[axis] += tensor.shape[axis];
    }
    let outer = first.split_at(axis)[0];
    if first.as_integers().is_ok() {
        // Shapes, which have one dimension.
        let values = all.iter().map(|tensor| tensor.as_integers()).collect::<Result<Vec<_>, _>>()?.concat();
        return Tensor::integers(shape, values);
    }
    let mut values = Vec::with_capacity(len(&shape)?);
    for block in 0..outer {
        for tensor in &all {
            let [_, own, inner] = tensor.split_at(axis);
            values.extend_from_slice(&tensor.as_floats()?[block * own * inner..][..own * inner]);
        }
    }
    Tensor::floats(shape, values)
}

fn slice(node: &Node, inputs: &Inputs) -> Result<Tensor, String> {
    let numbers = |index: usize, name: &str| match inputs.get(index).copied().flatten() {
        Some(tensor) => tensor.as_integers().map(<[i64]>::to_vec),
        None => Ok(node.attributes.get(name).map_or(Vec::new(), |numbers| numbers.integers.clone())),
    };
    let (starts, ends) = (numbers(1, "starts")?, numbers(2, "ends")?);
    let (axes, steps) = (numbers(3, "axes")?, numbers(4, "steps")?);
    let mut tensor = input(inputs, 0)?.clone();
    for (index, (start, end)) in starts.iter().zip(&ends).enumerate() {
        if steps.get(index).is_some_and(|step| *step != 1) {
            return Err("has a step other than 1, which is not supported".to_owned());
        }
        let axis = tensor.axis(axes.get(index).copied().unwrap_or(index as i64))?;
        let [outer, own, inner] = tensor.split_at(axis);
        let position =
            |value: i64| if value < 0 { value.saturating_add(own as i64) } else { value }.clamp(0, own as i64);
        let (start, end) = (position(*start) as usize, position(*end) as usize);
        let end = end.max(start);
        let mut shape = tensor.shape.clone();
        shape[axis] = end - start;
        let ranges = (0..outer).map(|block| (block * own + start) * inner..(block * own + end) * inner);
        tensor = match &tensor.data {
            Data::Float(values) => Tensor::floats(shape, ranges.flat_map(|range| values[range].to_vec()).collect())?,
            Data::Integer(values) => {
                Tensor::integers(shape, ranges.flat_map(|range| values[range].to_vec()).collect())?
            }
        };
    }
    Ok(tensor)
}

/// Returns the axes of an operation: an attribute, or its second input in newer files.
fn axes(node: &Node, inputs: &Inputs) -> Result<Vec<i64>, String> {
    match inputs.get(1).copied().flatten() {
        Some(axes) => axes.as_integers().map(<[i64]>::to_vec),
        None => Ok(node.attributes.get("axes").map_or(Vec::new(), |axes| axes.integers.clone())),
    }
}

fn reduce(node: &Node, inputs: &Inputs, f: &dyn Fn(&[f32]) -> f32) -> Result<Tensor, String> {
    let (x, axes) = (input(inputs, 0)?, axes(node, inputs)?);
    let [axis] = axes[..] else { return Err(format!("has {} axes; one is supported", axes.len())) };
    let axis = x.axis(axis)?;
    let ([outer, own, inner], values) = (x.split_at(axis), x.as_floats()?);
    let column =
        |block: usize, entry: usize| (0..own).map(|index| values[(block * own + index) * inner + entry]).collect();
    let reduced = (0..outer)
        .flat_map(|block| (0..inner).map(move |entry| (block, entry)))
        .map(|(block, entry)| f(&Vec::from_iter::<Vec<f32>>(column(block, entry))))
        .collect();
    let keep = node.attributes.get("keepdims").and_then(|keep| keep.integer).unwrap_or(1) != 0;
    let mut shape = x.shape.clone();
    if keep {
        shape[axis] = 1;
    } else {
        shape.remove(axis);
    }
    Tensor::floats(shape, reduced)
}

fn cast(x: &Tensor, to: i64) -> Result<Tensor, String> {
    match (&x.data, to) {
        (Data::Float(_), FLOAT) | (Data::Integer(_), INT64) => Ok(x.clone()),
        (Data::Integer(values), FLOAT) => {
            Tensor::floats(x.shape.clone(), values.iter().map(|value| *value as f32).collect())
        }
        (Data::Float(values), INT64) => {
            Tensor::integers(x.shape.clone(), values.iter().map(|value| *value as i64).collect())
        }
        _ => Err(format!("to type {to} is not supported; 32-bit floats (1) and 64-bit integers (7) are")),
    }
}

fn reshape(x: &Tensor, wanted: &[i64]) -> Result<Tensor, String> {
    let total: usize = x.shape.iter().product();
    let mut shape = Vec::with_capacity(wanted.len());
    for (index, len) in wanted.iter().enumerate() {
        shape.push(match *len {
            0 => *x.shape.get(index).ok_or("keeps a dimension that does not exist")?,
            -1 => 1,
            len => usize::try_from(len).map_err(|_| format!("has the length {len}"))?,
        });
    }
    if let Some(rest) = wanted.iter().position(|len| *len == -1) {
        shape[rest] = total.checked_div(len(&shape)?).unwrap_or(0);
    }
    x.reshaped(shape)
}

fn positive(shape: &[i64]) -> Result<Vec<usize>, String> {
    shape.iter().map(|len| usize::try_from(*len).map_err(|_| format!("has the length {len}"))).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;
    use crate::onnx::graph::Attribute;

    fn tensor(shape: &[usize], values: &[f32]) -> Tensor {
        Tensor::floats(shape.to_vec(), values.to_vec()).expect("a tensor")
    }

    fn integers(values: &[i64]) -> Tensor {
        Tensor::integers(vec![values.len()], values.to_vec()).expect("a tensor")
    }

    fn node(operator: &str, attributes: &[(&str, i64)]) -> Node {
        let attribute =
            |value: &i64| Attribute { integer: Some(*value), integers: vec![*value], ..Attribute::default() };
        let attributes: HashMap<_, _> =
            attributes.iter().map(|(name, value)| ((*name).to_owned(), attribute(value))).collect();
        Node { operator: operator.to_owned(), attributes, ..Node::default() }
    }

    fn result(operator: &str, attributes: &[(&str, i64)], inputs: &[&Tensor]) -> Tensor {
        let inputs: Vec<_> = inputs.iter().map(|input| Some(*input)).collect();
        evaluate(&node(operator, attributes), &inputs).unwrap_or_else(|problem| panic!("{operator} {problem}"))
    }

    #[test]
    fn gemm_is_that_of_the_specification() {
        let (x, c) = (tensor(&[1, 2], &[1.0, 2.0]), tensor(&[3], &[10.0, 20.0, 30.0]));
        let b = tensor(&[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let transposed = tensor(&[3, 2], &[1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
        let expected = tensor(&[1, 3], &[19.0, 32.0, 45.0]);
        assert_eq!(result("Gemm", &[], &[&x, &b, &c]), expected);
        assert_eq!(result("Gemm", &[("transB", 1)], &[&x, &transposed, &c]), expected);
        assert_eq!(result("MatMul", &[], &[&x, &b]), tensor(&[1, 3], &[9.0, 12.0, 15.0]));
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
        ] {
            let found = result(operator, &[], &[&x]);
            let near =
                found.as_floats().expect("floats").iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-6);
            assert!(near, "{operator}: {found:?}");
        }
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
        let bounds = [tensor(&[], &[1.5]), tensor(&[], &[3.5])];
        assert_eq!(result("Clip", &[], &[&x, &bounds[0], &bounds[1]]), tensor(&[1, 2, 2], &[1.5, 2.0, 3.0, 3.5]));
    }

    #[test]
    fn invalid_operations_are_errors() {
        let (x, y) = (tensor(&[1, 2], &[1.0, 2.0]), tensor(&[1, 3], &[1.0; 3]));
        for (operator, inputs) in [
            ("Add", vec![Some(&x), Some(&y)]),
            ("MatMul", vec![Some(&x), Some(&y)]),
            ("Add", vec![Some(&x), None]),
            ("Reshape", vec![Some(&x), Some(&y)]),
            ("Relu", Vec::new()),
            ("LSTM", vec![Some(&x)]),
        ] {
            assert!(evaluate(&node(operator, &[]), &inputs).is_err(), "{operator}");
        }
        let shape = integers(&[i64::MAX, i64::MAX]);
        assert!(evaluate(&node("Expand", &[]), &[Some(&x), Some(&shape)]).is_err());
        assert!(evaluate(&node("Reshape", &[]), &[Some(&x), Some(&integers(&[-1, 0, 0, 0]))]).is_err());
        assert!(evaluate(&node("Concat", &[("axis", 7)]), &[Some(&x)]).is_err());
    }
}
