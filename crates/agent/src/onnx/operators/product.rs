//! Matrix products and convolutions.

use super::Operation;
use crate::onnx::tensor::{Tensor, broadcast_shape, len, repeated};

type Outputs = Result<Vec<Tensor>, String>;

/// Most multiplications of one operation.
const MAX_WORK: usize = 1 << 28;

/// Evaluates an operation of this family. Returns `None` for another one.
pub fn evaluate(operation: &Operation) -> Option<Outputs> {
    let one = match operation.node.operator.as_str() {
        "Gemm" => gemm(operation),
        "MatMul" => matmul(operation),
        "Conv" => convolution(operation),
        _ => return None,
    };
    Some(one.map(|one| vec![one]))
}

/// Returns the product of `a` (rows × inner) and `b` (inner × columns), all row-major. Sums have double precision.
pub fn product(a: &[f32], b: &[f32], [rows, inner, columns]: [usize; 3]) -> Vec<f32> {
    let mut result = Vec::with_capacity(rows * columns);
    let mut sums = vec![0.0f64; columns];
    for row in 0..rows {
        sums.fill(0.0);
        // Weights are read in the order in which they are stored.
        for (factor, weights) in a[row * inner..][..inner].iter().zip(b.chunks_exact(columns.max(1))) {
            for (sum, weight) in sums.iter_mut().zip(weights) {
                *sum += f64::from(*factor) * f64::from(*weight);
            }
        }
        result.extend(sums.iter().map(|sum| *sum as f32));
    }
    result
}

/// Returns the product of `a` (rows × inner) and the transpose of `b` (columns × inner), as [`product`].
pub fn product_transposed(a: &[f32], b: &[f32], [rows, inner, columns]: [usize; 3]) -> Vec<f32> {
    if inner == 0 {
        return vec![0.0; rows * columns];
    }
    let row = |row: usize| {
        let factors = &a[row * inner..][..inner];
        b.chunks_exact(inner).take(columns).map(move |weights| dot(factors, weights))
    };
    (0..rows).flat_map(row).collect()
}

/// Returns the sum of the products, in four sums that the processor adds side by side.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a, b) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut sums = [0.0f64; 4];
    for (a, b) in a.0.iter().zip(b.0) {
        for lane in 0..4 {
            sums[lane] += f64::from(a[lane]) * f64::from(b[lane]);
        }
    }
    let rest: f64 = a.1.iter().zip(b.1).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
    (sums.iter().sum::<f64>() + rest) as f32
}

fn transposed(values: &[f32], [rows, columns]: [usize; 2]) -> Vec<f32> {
    (0..columns).flat_map(|column| (0..rows).map(move |row| values[row * columns + column])).collect()
}

fn check_work(lengths: &[usize]) -> Result<(), String> {
    let work = lengths.iter().try_fold(1usize, |product, len| product.checked_mul((*len).max(1)));
    if work.is_some_and(|work| work <= MAX_WORK) { Ok(()) } else { Err(format!("has too large arrays: {lengths:?}")) }
}

/// `alpha · a · b + beta · c`.
fn gemm(operation: &Operation) -> Result<Tensor, String> {
    let (a, b) = (operation.input(0)?, operation.input(1)?);
    let ([a_rows, a_columns], [b_rows, b_columns]) = (matrix(a)?, matrix(b)?);
    let is_transposed = ["transA", "transB"].map(|name| operation.integer(name, 0) != 0);
    let [rows, inner] = if is_transposed[0] { [a_columns, a_rows] } else { [a_rows, a_columns] };
    let [other, columns] = if is_transposed[1] { [b_columns, b_rows] } else { [b_rows, b_columns] };
    if inner != other {
        return Err(format!("has the dimensions {:?} and {:?}, which do not fit", a.shape, b.shape));
    }
    check_work(&[rows, inner, columns])?;
    let own;
    let values = if is_transposed[0] {
        own = transposed(a.as_floats()?, [a_rows, a_columns]);
        &own[..]
    } else {
        a.as_floats()?
    };
    len(&[rows, columns])?;
    let mut result = if is_transposed[1] {
        product_transposed(values, b.as_floats()?, [rows, inner, columns])
    } else {
        product(values, b.as_floats()?, [rows, inner, columns])
    };
    let (alpha, beta) = (operation.float("alpha", 1.0), operation.float("beta", 1.0));
    for value in &mut result {
        *value *= alpha;
    }
    if let Some(c) = operation.optional(2) {
        let c = repeated(c, &[rows, columns])?;
        result.iter_mut().zip(c.as_floats()?).for_each(|(value, c)| *value += beta * c);
    }
    Tensor::floats(vec![rows, columns], result)
}

fn matrix(tensor: &Tensor) -> Result<[usize; 2], String> {
    tensor.shape[..].try_into().map_err(|_| format!("has the dimensions {:?}; a matrix is expected", tensor.shape))
}

/// The matrix product of NumPy: the last two dimensions, for each entry of the ones before.
fn matmul(operation: &Operation) -> Result<Tensor, String> {
    let (a, b) = (operation.input(0)?, operation.input(1)?);
    let (is_row, is_column) = (a.shape.len() == 1, b.shape.len() == 1);
    let a = if is_row { a.reshaped(vec![1, a.len()])? } else { a.clone() };
    let b = if is_column { b.reshaped(vec![b.len(), 1])? } else { b.clone() };
    let ([outer_a @ .., rows, inner], [outer_b @ .., other, columns]) = (&a.shape[..], &b.shape[..]) else {
        return Err("has a number where a matrix is expected".to_owned());
    };
    let (rows, inner, columns) = (*rows, *inner, *columns);
    if inner != *other {
        return Err(format!("has the dimensions {:?} and {:?}, which do not fit", a.shape, b.shape));
    }
    let outer = broadcast_shape(outer_a, outer_b)?;
    let all = |tensor: &Tensor, own: [usize; 2]| repeated(tensor, &[&outer[..], &own[..]].concat());
    let (a, b) = (all(&a, [rows, inner])?, all(&b, [inner, columns])?);
    let blocks: usize = outer.iter().product();
    check_work(&[blocks, rows, inner, columns])?;
    let mut shape = outer.clone();
    if !is_row {
        shape.push(rows);
    }
    if !is_column {
        shape.push(columns);
    }
    let (left, right) = (a.as_floats()?, b.as_floats()?);
    let mut values = Vec::with_capacity(len(&shape)?);
    for block in 0..blocks {
        let left = &left[block * rows * inner..][..rows * inner];
        let right = &right[block * inner * columns..][..inner * columns];
        values.extend(product(left, right, [rows, inner, columns]));
    }
    Tensor::floats(shape, values)
}

/// A convolution along one or two dimensions.
fn convolution(operation: &Operation) -> Result<Tensor, String> {
    let (x, weights) = (operation.input(0)?, operation.input(1)?);
    let spatial = x.shape.len().saturating_sub(2);
    if !(1..=2).contains(&spatial) || weights.shape.len() != x.shape.len() {
        return Err(format!("has the dimensions {:?} and {:?}; one or two are supported", x.shape, weights.shape));
    }
    // One dimension is two with a height of 1.
    let two = |shape: &[usize]| if spatial == 1 { [1, shape[2]] } else { [shape[2], shape[3]] };
    let (size, kernel) = (two(&x.shape), two(&weights.shape));
    let strides = pair(operation, "strides", spatial, 1)?;
    let dilations = pair(operation, "dilations", spatial, 1)?;
    let extent = [0, 1].map(|axis| (kernel[axis].max(1) - 1).saturating_mul(dilations[axis]).saturating_add(1));
    let begin = padding(operation, spatial, size, extent, strides)?;
    let mut out = [0; 2];
    for axis in [0, 1] {
        let padded = size[axis] + begin[axis][0] + begin[axis][1];
        if padded < extent[axis] {
            return Err(format!("has a kernel of {} for a length of {padded}", extent[axis]));
        }
        out[axis] = (padded - extent[axis]) / strides[axis] + 1;
    }
    let [batch, channels] = [x.shape[0], x.shape[1]];
    let [filters, own] = [weights.shape[0], weights.shape[1]];
    let groups =
        usize::try_from(operation.integer("group", 1)).ok().filter(|groups| *groups > 0).ok_or("has no groups")?;
    if own * groups != channels || filters % groups != 0 {
        return Err(format!("has {channels} channels in {groups} groups for weights {:?}", weights.shape));
    }
    check_work(&[batch, filters, out[0], out[1], own, kernel[0], kernel[1]])?;
    let mut shape = vec![batch, filters];
    shape.extend(&out[2 - spatial..]);
    let mut values = vec![0.0; len(&shape)?];
    let (input, weights) = (x.as_floats()?, weights.as_floats()?);
    let bias = operation.optional(2).map(Tensor::as_floats).transpose()?;
    if bias.is_some_and(|bias| bias.len() != filters) {
        return Err(format!("has a bias of another length than {filters}"));
    }
    for (index, value) in values.iter_mut().enumerate() {
        let (column, row) = (index % out[1], index / out[1] % out[0]);
        let (filter, lane) = (index / out[1] / out[0] % filters, index / out[1] / out[0] / filters);
        let mut sum = bias.map_or(0.0, |bias| bias[filter]);
        for channel in 0..own {
            let from = (lane * channels + filter / (filters / groups) * own + channel) * size[0] * size[1];
            for i in 0..kernel[0] {
                // A position in the padding wraps to one outside.
                let y = (row * strides[0] + i * dilations[0]).wrapping_sub(begin[0][0]);
                for j in 0..kernel[1] {
                    let z = (column * strides[1] + j * dilations[1]).wrapping_sub(begin[1][0]);
                    if y < size[0] && z < size[1] {
                        let weight = weights[((filter * own + channel) * kernel[0] + i) * kernel[1] + j];
                        sum += weight * input[from + y * size[1] + z];
                    }
                }
            }
        }
        *value = sum;
    }
    Tensor::floats(shape, values)
}

/// Returns an attribute of one number for each of one or two dimensions.
fn pair(operation: &Operation, name: &str, spatial: usize, default: usize) -> Result<[usize; 2], String> {
    let Some(numbers) = operation.integers(name, usize::MAX)?.filter(|numbers| !numbers.is_empty()) else {
        return Ok([default; 2]);
    };
    let valid: Option<Vec<usize>> =
        numbers.iter().map(|number| usize::try_from(*number).ok().filter(|one| (1..1 << 20).contains(one))).collect();
    match (valid.as_deref(), spatial) {
        (Some([one]), 1) => Ok([default, *one]),
        (Some([one, other]), 2) => Ok([*one, *other]),
        _ => Err(format!("has `{name}` = {numbers:?}")),
    }
}

/// Returns the padding before and behind each dimension.
fn padding(
    operation: &Operation,
    spatial: usize,
    size: [usize; 2],
    extent: [usize; 2],
    strides: [usize; 2],
) -> Result<[[usize; 2]; 2], String> {
    let mode = operation.text("auto_pad").unwrap_or("NOTSET");
    if mode.starts_with("SAME") {
        return Ok([0, 1].map(|axis| {
            let steps = size[axis].div_ceil(strides[axis]).max(1) - 1;
            let total = (steps * strides[axis] + extent[axis]).saturating_sub(size[axis]);
            let (less, more) = (total / 2, total.div_ceil(2));
            if mode == "SAME_LOWER" { [more, less] } else { [less, more] }
        }));
    }
    let pads = operation.integers("pads", usize::MAX)?.unwrap_or_default();
    let valid: Option<Vec<usize>> =
        pads.iter().map(|pad| usize::try_from(*pad).ok().filter(|pad| *pad < 1 << 20)).collect();
    match (valid.as_deref(), spatial) {
        (Some([]), _) => Ok([[0; 2]; 2]),
        (Some([begin, end]), 1) => Ok([[0, 0], [*begin, *end]]),
        (Some([top, left, bottom, right]), 2) => Ok([[*top, *bottom], [*left, *right]]),
        _ => Err(format!("has `pads` = {pads:?}")),
    }
}
