//! Operators that give the same entries in another order or shape, and those that make shapes.

use super::Operation;
use crate::onnx::tensor::{Data, Tensor, broadcast_shape, len, repeated};

type Outputs = Result<Vec<Tensor>, String>;

/// Evaluates an operation of this family. Returns `None` for another one.
pub fn evaluate(operation: &Operation) -> Option<Outputs> {
    let one = match operation.node.operator.as_str() {
        "Constant" => constant(operation),
        "ConstantOfShape" => constant_of_shape(operation),
        "Shape" => shape(operation),
        "Size" => operation.input(0).and_then(|x| Tensor::integers(Vec::new(), vec![x.len() as i64])),
        "Range" => range(operation),
        "Reshape" => reshape(operation),
        "Flatten" => flatten(operation),
        "Squeeze" => squeeze(operation),
        "Unsqueeze" => unsqueeze(operation),
        "Expand" => expand(operation),
        "Tile" => tile(operation),
        "Transpose" => transpose(operation),
        "Concat" => concat(operation),
        "Slice" => slice(operation),
        "Gather" => gather(operation),
        "GatherElements" => gather_elements(operation),
        "Pad" => pad(operation),
        "Split" => return Some(split(operation)),
        _ => return None,
    };
    Some(one.map(|one| vec![one]))
}

fn constant(operation: &Operation) -> Result<Tensor, String> {
    let attribute = |name: &str| operation.node.attributes.get(name);
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

fn constant_of_shape(operation: &Operation) -> Result<Tensor, String> {
    let shape = lengths(operation.input(0)?.as_integers()?)?;
    let zero = Tensor::floats(vec![1], vec![0.0])?;
    let value = operation.node.attributes.get("value").and_then(|value| value.tensor.as_ref()).unwrap_or(&zero);
    if value.len() != 1 {
        return Err(format!("has a value of {} entries; one is expected", value.len()));
    }
    value.picked(shape, |_| 0)
}

fn shape(operation: &Operation) -> Result<Tensor, String> {
    let shape = &operation.input(0)?.shape;
    let position = |value: i64| {
        let value = if value < 0 { value + shape.len() as i64 } else { value };
        value.clamp(0, shape.len() as i64) as usize
    };
    let (start, end) = (position(operation.integer("start", 0)), position(operation.integer("end", i64::MAX)));
    let part: Vec<i64> = shape[start..end.max(start)].iter().map(|len| *len as i64).collect();
    Tensor::integers(vec![part.len()], part)
}

fn range(operation: &Operation) -> Result<Tensor, String> {
    let [start, limit, delta] = [operation.input(0)?, operation.input(1)?, operation.input(2)?];
    if let (Ok([start]), Ok([limit]), Ok([delta])) = (start.as_integers(), limit.as_integers(), delta.as_integers()) {
        let count = (limit.saturating_sub(*start) as f64 / *delta as f64).ceil().max(0.0);
        let count = len(&[count as usize])?;
        return Tensor::integers(
            vec![count],
            (0..count as i64).map(|i| start.wrapping_add(i.wrapping_mul(*delta))).collect(),
        );
    }
    let (Ok([start]), Ok([limit]), Ok([delta])) = (start.as_floats(), limit.as_floats(), delta.as_floats()) else {
        return Err("has bounds that are no numbers".to_owned());
    };
    let count = len(&[((limit - start) / delta).ceil().max(0.0) as usize])?;
    Tensor::floats(vec![count], (0..count).map(|i| start + i as f32 * delta).collect())
}

fn reshape(operation: &Operation) -> Result<Tensor, String> {
    let (x, wanted) = (operation.input(0)?, operation.input(1)?.as_integers()?);
    let allows_zero = operation.integer("allowzero", 0) != 0;
    let mut shape = Vec::with_capacity(wanted.len());
    for (index, len) in wanted.iter().enumerate() {
        shape.push(match *len {
            0 if !allows_zero => *x.shape.get(index).ok_or("keeps a dimension that does not exist")?,
            -1 => 1,
            len => usize::try_from(len).map_err(|_| format!("has the length {len}"))?,
        });
    }
    if let Some(rest) = wanted.iter().position(|len| *len == -1) {
        shape[rest] = x.len().checked_div(len(&shape)?).unwrap_or(0);
    }
    x.reshaped(shape)
}

fn flatten(operation: &Operation) -> Result<Tensor, String> {
    let (x, axis) = (operation.input(0)?, operation.integer("axis", 1));
    let axis = if axis == x.shape.len() as i64 { x.shape.len() } else { x.axis(axis)? };
    x.reshaped(vec![x.shape[..axis].iter().product(), x.shape[axis..].iter().product()])
}

fn squeeze(operation: &Operation) -> Result<Tensor, String> {
    let (x, axes) = (operation.input(0)?, operation.integers("axes", 1)?.unwrap_or_default());
    let removed = axes.iter().map(|axis| x.axis(*axis)).collect::<Result<Vec<_>, _>>()?;
    let is_kept = |(axis, len): &(usize, &usize)| {
        if removed.is_empty() { **len != 1 } else { !removed.contains(axis) }
    };
    x.reshaped(x.shape.iter().enumerate().filter(is_kept).map(|(_, len)| *len).collect())
}

fn unsqueeze(operation: &Operation) -> Result<Tensor, String> {
    let (x, mut axes) = (operation.input(0)?, operation.integers("axes", 1)?.unwrap_or_default());
    let rank = (x.shape.len() + axes.len()) as i64;
    axes.iter_mut().filter(|axis| **axis < 0).for_each(|axis| *axis += rank);
    axes.sort_unstable();
    let mut shape = x.shape.clone();
    for axis in axes {
        let position = usize::try_from(axis).ok().filter(|position| *position <= shape.len());
        shape.insert(position.ok_or("has an axis out of range")?, 1);
    }
    x.reshaped(shape)
}

fn expand(operation: &Operation) -> Result<Tensor, String> {
    let (x, wanted) = (operation.input(0)?, lengths(operation.input(1)?.as_integers()?)?);
    repeated(x, &broadcast_shape(&x.shape, &wanted)?)
}

fn tile(operation: &Operation) -> Result<Tensor, String> {
    let (x, repeats) = (operation.input(0)?, lengths(operation.input(1)?.as_integers()?)?);
    if repeats.len() != x.shape.len() {
        return Err(format!("has {} repeats for the dimensions {:?}", repeats.len(), x.shape));
    }
    let shape: Option<Vec<usize>> = x.shape.iter().zip(&repeats).map(|(len, times)| len.checked_mul(*times)).collect();
    let shape = shape.ok_or("makes an array that is too large")?;
    let target = Strides::of(&shape);
    x.picked(shape.clone(), |entry| target.source(entry, &x.shape, |axis, position| position % x.shape[axis]))
}

fn transpose(operation: &Operation) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let order = match operation.integers("perm", usize::MAX)? {
        Some(order) => order.iter().map(|axis| x.axis(*axis)).collect::<Result<Vec<_>, _>>()?,
        None => (0..x.shape.len()).rev().collect(),
    };
    let is_permutation = (0..x.shape.len()).all(|axis| order.contains(&axis)) && order.len() == x.shape.len();
    if !is_permutation {
        return Err(format!("has the order {order:?} for {} dimensions", x.shape.len()));
    }
    let shape: Vec<usize> = order.iter().map(|axis| x.shape[*axis]).collect();
    let (target, source) = (Strides::of(&shape), Strides::of(&x.shape));
    let index =
        |entry: usize| (0..order.len()).map(|axis| target.position(entry, axis) * source.0[order[axis]].1).sum();
    x.picked(shape.clone(), index)
}

fn concat(operation: &Operation) -> Result<Tensor, String> {
    let first = operation.input(0)?;
    let axis = first.axis(operation.integer("axis", 0))?;
    let mut shape = first.shape.clone();
    shape[axis] = 0;
    let all = (0..operation.inputs.len()).map(|index| operation.input(index)).collect::<Result<Vec<_>, _>>()?;
    for tensor in &all {
        let same = |(index, (one, other)): (usize, (&usize, &usize))| index == axis || one == other;
        if tensor.shape.len() != shape.len() || !tensor.shape.iter().zip(&first.shape).enumerate().all(same) {
            return Err(format!("has the dimensions {:?} and {:?}, which do not fit", first.shape, tensor.shape));
        }
        shape[axis] += tensor.shape[axis];
    }
    let (outer, total) = (first.split_at(axis)[0], len(&shape)?);
    let block = |tensor: &Tensor, block: usize| {
        let [_, own, inner] = tensor.split_at(axis);
        block * own * inner..(block + 1) * own * inner
    };
    match &first.data {
        Data::Float(_) => {
            let mut values = Vec::with_capacity(total);
            for index in 0..outer {
                for tensor in &all {
                    values.extend_from_slice(&tensor.as_floats()?[block(tensor, index)]);
                }
            }
            Tensor::floats(shape, values)
        }
        Data::Integer(_) => {
            let mut values = Vec::with_capacity(total);
            for index in 0..outer {
                for tensor in &all {
                    values.extend_from_slice(&tensor.as_integers()?[block(tensor, index)]);
                }
            }
            Tensor::integers(shape, values)
        }
    }
}

fn slice(operation: &Operation) -> Result<Tensor, String> {
    let numbers = |index: usize, name: &str| operation.integers(name, index);
    let (starts, ends) = (numbers(1, "starts")?.unwrap_or_default(), numbers(2, "ends")?.unwrap_or_default());
    let (axes, steps) = (numbers(3, "axes")?, numbers(4, "steps")?);
    let mut tensor = operation.input(0)?.clone();
    for (index, (start, end)) in starts.iter().zip(&ends).enumerate() {
        let step = steps.as_ref().and_then(|steps| steps.get(index).copied()).unwrap_or(1);
        let axis = axes.as_ref().and_then(|axes| axes.get(index).copied()).unwrap_or(index as i64);
        let axis = tensor.axis(axis)?;
        let own = tensor.shape[axis] as i64;
        let position = |value: i64| if value < 0 { value.saturating_add(own) } else { value };
        let (first, count) = match step {
            _ if own == 0 => (0, 0),
            0 => return Err("has a step of 0".to_owned()),
            1.. => {
                let (start, end) = (position(*start).clamp(0, own), position(*end).clamp(0, own));
                (start, (end - start).max(0).unsigned_abs().div_ceil(step.unsigned_abs()))
            }
            _ => {
                let (start, end) = (position(*start).clamp(0, own - 1), position(*end).clamp(-1, own - 1));
                (start, (start - end).max(0).unsigned_abs().div_ceil(step.unsigned_abs()))
            }
        };
        tensor = picked_along(&tensor, axis, count as usize, |entry| (first + entry as i64 * step) as usize)?;
    }
    Ok(tensor)
}

fn gather(operation: &Operation) -> Result<Tensor, String> {
    let (x, indices) = (operation.input(0)?, operation.input(1)?);
    let axis = x.axis(operation.integer("axis", 0))?;
    let positions = positions(indices.as_integers()?, x.shape[axis])?;
    let result = picked_along(x, axis, positions.len(), |entry| positions[entry])?;
    let shape = [&x.shape[..axis], &indices.shape[..], &x.shape[axis + 1..]].concat();
    result.reshaped(shape)
}

fn gather_elements(operation: &Operation) -> Result<Tensor, String> {
    let (x, indices) = (operation.input(0)?, operation.input(1)?);
    let axis = x.axis(operation.integer("axis", 0))?;
    let positions = positions(indices.as_integers()?, x.shape[axis])?;
    let fits = x.shape.len() == indices.shape.len()
        && (0..x.shape.len()).all(|other| other == axis || indices.shape[other] <= x.shape[other]);
    if !fits {
        return Err(format!("has the dimensions {:?} and {:?}, which do not fit", x.shape, indices.shape));
    }
    let target = Strides::of(&indices.shape);
    x.picked(indices.shape.clone(), |entry| {
        target.source(entry, &x.shape, |other, position| if other == axis { positions[entry] } else { position })
    })
}

fn pad(operation: &Operation) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let given = operation.integers("pads", 1)?.unwrap_or_default();
    let mode = operation.text("mode").unwrap_or("constant").to_owned();
    let rank = x.shape.len();
    let axes = match operation.optional(3) {
        Some(axes) => axes.as_integers()?.iter().map(|axis| x.axis(*axis)).collect::<Result<_, _>>()?,
        None => (0..rank).collect::<Vec<_>>(),
    };
    if given.len() != 2 * axes.len() || !matches!(mode.as_str(), "constant" | "edge") {
        return Err(format!("has {} pads, mode `{mode}`; two for each dimension, constant or edge", given.len()));
    }
    let mut pads = vec![0; 2 * rank];
    for (index, axis) in axes.iter().enumerate() {
        (pads[*axis], pads[rank + axis]) = (given[index], given[axes.len() + index]);
    }
    let padded = |axis: usize| {
        usize::try_from(pads[axis].checked_add(x.shape[axis] as i64)?.checked_add(pads[rank + axis])?).ok()
    };
    let shape: Option<Vec<usize>> = (0..rank).map(padded).collect();
    let shape = shape.ok_or("has pads out of range")?;
    if x.len() == 0 {
        return Err("pads an empty array".to_owned());
    }
    let target = Strides::of(&shape);
    let inner = |entry: usize, axis: usize| target.position(entry, axis) as i64 - pads[axis];
    let nearest = |entry: usize| {
        target.source(entry, &x.shape, |axis, _| inner(entry, axis).clamp(0, x.shape[axis] as i64 - 1) as usize)
    };
    let mut result = x.picked(shape.clone(), nearest)?;
    if mode == "constant" {
        let is_outside = |entry: usize| (0..rank).any(|axis| !(0..x.shape[axis] as i64).contains(&inner(entry, axis)));
        let value = operation
            .optional(2)
            .map_or(operation.float("value", 0.0), |value| value.to_floats().first().copied().unwrap_or(0.0));
        match &mut result.data {
            Data::Float(values) => {
                values.iter_mut().enumerate().filter(|(entry, _)| is_outside(*entry)).for_each(|(_, one)| *one = value);
            }
            Data::Integer(values) => {
                values
                    .iter_mut()
                    .enumerate()
                    .filter(|(entry, _)| is_outside(*entry))
                    .for_each(|(_, one)| *one = value as i64);
            }
        }
    }
    Ok(result)
}

fn split(operation: &Operation) -> Outputs {
    let x = operation.input(0)?;
    let axis = x.axis(operation.integer("axis", 0))?;
    let (own, count) = (x.shape[axis], operation.node.outputs.len().max(1));
    // Equal parts; the last one may be smaller.
    let part = own.div_ceil(count);
    let equal = (0..count).map(|index| part.min(own.saturating_sub(index * part))).collect();
    let given = operation.integers("split", 1)?.map(|parts| lengths(&parts)).transpose()?;
    let parts: Vec<usize> = given.unwrap_or(equal);
    if parts.iter().try_fold(0usize, |sum, part| sum.checked_add(*part)) != Some(own) {
        return Err(format!("has the parts {parts:?} of a dimension of {own}"));
    }
    let starts = parts.iter().scan(0, |sum, part| {
        *sum += part;
        Some(*sum - part)
    });
    starts.zip(&parts).map(|(start, part)| picked_along(x, axis, *part, |entry| start + entry)).collect()
}

/// Returns the array with `count` entries along a dimension: entry `i` is that at `position(i)`.
fn picked_along(x: &Tensor, axis: usize, count: usize, position: impl Fn(usize) -> usize) -> Result<Tensor, String> {
    let [_, own, inner] = x.split_at(axis);
    let mut shape = x.shape.clone();
    shape[axis] = count;
    x.picked(shape, |entry| {
        let (block, rest) = (entry / (count * inner), entry % (count * inner));
        (block * own + position(rest / inner)) * inner + rest % inner
    })
}

/// Returns indices of a dimension; negative ones count from its end.
fn positions(indices: &[i64], own: usize) -> Result<Vec<usize>, String> {
    let one = |index: &i64| {
        let position = if *index < 0 { index + own as i64 } else { *index };
        usize::try_from(position).ok().filter(|position| *position < own)
    };
    let found: Option<Vec<usize>> = indices.iter().map(one).collect();
    found.ok_or_else(|| format!("has an index outside a dimension of {own}"))
}

fn lengths(shape: &[i64]) -> Result<Vec<usize>, String> {
    shape.iter().map(|len| usize::try_from(*len).map_err(|_| format!("has the length {len}"))).collect()
}

/// Length and stride of each dimension.
struct Strides(Vec<(usize, usize)>);

impl Strides {
    fn of(shape: &[usize]) -> Self {
        let mut strides = vec![(0, 1); shape.len()];
        let mut stride = 1usize;
        for (axis, len) in shape.iter().enumerate().rev() {
            strides[axis] = (*len, stride);
            stride = stride.saturating_mul(*len);
        }
        Self(strides)
    }

    /// Returns the position of an entry along a dimension.
    fn position(&self, entry: usize, axis: usize) -> usize {
        let (len, stride) = self.0[axis];
        entry / stride % len
    }

    /// Returns the entry of an array of `shape` whose position along each dimension is `of(axis, own position)`.
    fn source(&self, entry: usize, shape: &[usize], of: impl Fn(usize, usize) -> usize) -> usize {
        (0..shape.len()).fold(0, |sum, axis| sum * shape[axis] + of(axis, self.position(entry, axis)))
    }
}
