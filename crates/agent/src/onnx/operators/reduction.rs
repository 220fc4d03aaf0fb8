//! Sums, means and extremes along dimensions, and what is computed from them.

use super::Operation;
use crate::onnx::tensor::{Data, Tensor, repeated};

type Outputs = Result<Vec<Tensor>, String>;

/// Evaluates an operation of this family. Returns `None` for another one.
pub fn evaluate(operation: &Operation) -> Option<Outputs> {
    let one = match operation.node.operator.as_str() {
        "ReduceSum" => reduce(operation, |values| values.iter().sum()),
        "ReduceMean" => reduce(operation, mean),
        "ReduceMax" => reduce(operation, largest),
        "ReduceMin" => reduce(operation, |values| values.iter().copied().fold(f32::INFINITY, f32::min)),
        "ReduceProd" => reduce(operation, |values| values.iter().product()),
        "ReduceL1" => reduce(operation, |values| values.iter().map(|x| x.abs()).sum()),
        "ReduceL2" => reduce(operation, |values| square_sum(values).sqrt()),
        "ReduceSumSquare" => reduce(operation, square_sum),
        "ReduceLogSum" => reduce(operation, |values| values.iter().sum::<f32>().ln()),
        "ReduceLogSumExp" => reduce(operation, log_sum_exp),
        "ArgMax" => extreme(operation, |one, other| one > other),
        "ArgMin" => extreme(operation, |one, other| one < other),
        "Softmax" => along(operation, |values| {
            let largest = largest(values);
            for x in values.iter_mut() {
                *x = (*x - largest).exp();
            }
            let sum: f32 = values.iter().sum();
            for x in values.iter_mut() {
                *x /= sum;
            }
        }),
        "LogSoftmax" => along(operation, |values| {
            let largest = largest(values);
            let sum = values.iter().map(|x| (x - largest).exp()).sum::<f32>().ln();
            for x in values.iter_mut() {
                *x = *x - largest - sum;
            }
        }),
        "LpNormalization" => {
            let is_one = operation.integer("p", 2) == 1;
            along(operation, move |values| {
                let norm = if is_one { values.iter().map(|x| x.abs()).sum() } else { square_sum(values).sqrt() };
                for x in values.iter_mut() {
                    *x /= norm;
                }
            })
        }
        "LayerNormalization" => return Some(layer_normalisation(operation)),
        "BatchNormalization" => batch_normalisation(operation),
        _ => return None,
    };
    Some(one.map(|one| vec![one]))
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len() as f32
}

fn square_sum(values: &[f32]) -> f32 {
    values.iter().map(|x| x * x).sum()
}

fn largest(values: &[f32]) -> f32 {
    values.iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

/// ln Σ eˣ without overflow.
fn log_sum_exp(values: &[f32]) -> f32 {
    let largest = largest(values);
    largest + values.iter().map(|x| (x - largest).exp()).sum::<f32>().ln()
}

fn reduce(operation: &Operation, f: impl Fn(&[f32]) -> f32) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let axes = operation.integers("axes", 1)?.unwrap_or_default();
    if axes.is_empty() && operation.integer("noop_with_empty_axes", 0) != 0 {
        return Ok(x.clone());
    }
    let mut axes = axes.iter().map(|axis| x.axis(*axis)).collect::<Result<Vec<_>, _>>()?;
    if axes.is_empty() {
        axes = (0..x.shape.len()).collect();
    }
    let is_reduced: Vec<bool> = (0..x.shape.len()).map(|axis| axes.contains(&axis)).collect();
    let kept: Vec<usize> =
        x.shape.iter().zip(&is_reduced).map(|(len, reduced)| if *reduced { 1 } else { *len }).collect();
    let groups: usize = kept.iter().product();
    let values = x.to_floats();
    let mut parts = vec![Vec::new(); groups];
    for (entry, value) in values.iter().enumerate() {
        let (mut rest, mut group, mut stride) = (entry, 0, 1);
        for ((len, kept), reduced) in x.shape.iter().zip(&kept).zip(&is_reduced).rev() {
            group += if *reduced { 0 } else { rest % len * stride };
            (rest, stride) = (rest / len, stride * kept);
        }
        parts[group].push(*value);
    }
    let result: Vec<f32> = parts.iter().map(|part| f(part)).collect();
    let shape = if operation.integer("keepdims", 1) != 0 {
        kept
    } else {
        x.shape.iter().zip(&is_reduced).filter(|(_, reduced)| !**reduced).map(|(len, _)| *len).collect()
    };
    match x.data {
        Data::Float(_) => Tensor::floats(shape, result),
        Data::Integer(_) => Tensor::integers(shape, result.into_iter().map(|value| value as i64).collect()),
    }
}

/// Returns the index of the extreme along a dimension: the first, or with `select_last_index` the last.
fn extreme(operation: &Operation, is_better: fn(f32, f32) -> bool) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let axis = x.axis(operation.integer("axis", 0))?;
    let ([outer, own, inner], values) = (x.split_at(axis), x.to_floats());
    if own == 0 {
        return Err("has a dimension without entries".to_owned());
    }
    let is_last = operation.integer("select_last_index", 0) != 0;
    let best = |block: usize, entry: usize| {
        let at = |index: usize| values[(block * own + index) * inner + entry];
        let wins = |index: usize, best: usize| is_better(at(index), at(best)) || is_last && at(index) == at(best);
        (1..own).fold(0, |best, index| if wins(index, best) { index } else { best }) as i64
    };
    let found = (0..outer).flat_map(|block| (0..inner).map(move |entry| (block, entry)));
    let found: Vec<i64> = found.map(|(block, entry)| best(block, entry)).collect();
    let mut shape = x.shape.clone();
    if operation.integer("keepdims", 1) != 0 {
        shape[axis] = 1;
    } else {
        shape.remove(axis);
    }
    Tensor::integers(shape, found)
}

/// Applies a function to the entries along a dimension.
fn along(operation: &Operation, f: impl Fn(&mut [f32])) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let axis = x.axis(operation.integer("axis", -1))?;
    let [outer, own, inner] = x.split_at(axis);
    let mut values = x.as_floats()?.to_vec();
    let mut part = vec![0.0; own];
    for block in 0..outer {
        for entry in 0..inner {
            let position = |index: usize| (block * own + index) * inner + entry;
            part.iter_mut().enumerate().for_each(|(index, one)| *one = values[position(index)]);
            f(&mut part);
            part.iter().enumerate().for_each(|(index, one)| values[position(index)] = *one);
        }
    }
    Tensor::floats(x.shape.clone(), values)
}

fn layer_normalisation(operation: &Operation) -> Outputs {
    let x = operation.input(0)?;
    let axis = x.axis(operation.integer("axis", -1))?;
    let own: usize = x.shape[axis..].iter().product();
    let epsilon = operation.float("epsilon", 1e-5);
    let of = |index: usize| operation.optional(index).map(|tensor| repeated(tensor, &x.shape[axis..])).transpose();
    let scale = of(1)?.ok_or("has no scale")?;
    let (scale, bias) = (scale.as_floats()?, of(2)?);
    let bias = bias.as_ref().map(Tensor::as_floats).transpose()?;
    let mut values = x.as_floats()?.to_vec();
    for part in values.chunks_exact_mut(own.max(1)) {
        let mean = mean(part);
        let variance = part.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / own as f32;
        let factor = 1.0 / (variance + epsilon).sqrt();
        for (entry, value) in part.iter_mut().enumerate() {
            *value = (*value - mean) * factor * scale[entry] + bias.map_or(0.0, |bias| bias[entry]);
        }
    }
    Tensor::floats(x.shape.clone(), values).map(|one| vec![one])
}

/// Batch normalisation as in use, with the mean and variance of the training.
fn batch_normalisation(operation: &Operation) -> Result<Tensor, String> {
    let x = operation.input(0)?;
    let (channels, epsilon) = (*x.shape.get(1).ok_or("has no channels")?, operation.float("epsilon", 1e-5));
    let of = |index: usize| {
        let values = operation.input(index)?.as_floats()?;
        if values.len() == channels {
            Ok(values)
        } else {
            Err(format!("has {} numbers for {channels} channels", values.len()))
        }
    };
    let (scale, bias, mean, variance) = (of(1)?, of(2)?, of(3)?, of(4)?);
    let inner: usize = x.shape[2..].iter().product();
    let one = |(entry, value): (usize, &f32)| {
        let channel = entry / inner % channels;
        (value - mean[channel]) / (variance[channel] + epsilon).sqrt() * scale[channel] + bias[channel]
    };
    Tensor::floats(x.shape.clone(), x.as_floats()?.iter().enumerate().map(one).collect())
}
