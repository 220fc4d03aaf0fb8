//! A multilayer perceptron with rectified linear units, its parameters, and their initial values.

use rand::Rng;
use twinstep_model::standard_normal;

use crate::matrix::{COLUMN_STEP, ROW_STEP};

/// Parameters of a multilayer perceptron: linear layers with rectified linear units between them.
///
/// Sizes are padded for the SIMD registers; padded weights and biases are zero and stay zero.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    sizes: Vec<usize>,
    /// Weight and bias of each layer, with padding.
    pub parameters: Vec<f32>,
}

/// Position of a layer in [`Mlp::parameters`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LayerLayout {
    /// Number of inputs.
    pub inputs: usize,
    /// Number of outputs.
    pub outputs: usize,
    /// Number of rows of the weight, at least `inputs`.
    pub rows: usize,
    /// Number of columns of the weight, at least `outputs`.
    pub columns: usize,
    /// Index of the first weight; the weight is row-major, inputs by outputs. The bias follows.
    pub start: usize,
}

impl LayerLayout {
    /// Returns the index range of the weight.
    pub fn weight(&self) -> std::ops::Range<usize> {
        self.start..self.start + self.rows * self.columns
    }

    /// Returns the index range of the bias.
    pub fn bias(&self) -> std::ops::Range<usize> {
        self.weight().end..self.weight().end + self.columns
    }
}

impl Mlp {
    /// Creates a network of zeros. `sizes` are the numbers of inputs, of units of each hidden layer, and of outputs.
    pub fn zeros(sizes: &[usize]) -> Self {
        assert!(sizes.len() > 1 && sizes.iter().all(|size| *size > 0), "a network has inputs and outputs");
        let mut network = Self { sizes: sizes.to_vec(), parameters: Vec::new() };
        let len = network.layers().last().map_or(0, |layer| layer.bias().end);
        network.parameters = vec![0.0; len];
        network
    }

    /// Creates a network with orthogonal weights and zero biases.
    ///
    /// The gain is √2 for hidden layers and `output_gain` for the last one.
    pub fn orthogonal(sizes: &[usize], output_gain: f32, random: &mut impl Rng) -> Self {
        let mut network = Self::zeros(sizes);
        let last = sizes.len() - 2;
        for (index, layer) in network.layers().into_iter().enumerate() {
            let gain = if index == last { output_gain } else { std::f32::consts::SQRT_2 };
            let weight = orthogonal(layer.inputs, layer.outputs, random);
            for input in 0..layer.inputs {
                for output in 0..layer.outputs {
                    network.parameters[layer.start + input * layer.columns + output] =
                        gain * weight[input * layer.outputs + output];
                }
            }
        }
        network
    }

    /// Returns the numbers of inputs, of units of each hidden layer, and of outputs.
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.sizes[0]
    }

    /// Returns the number of outputs.
    pub fn outputs(&self) -> usize {
        self.sizes[self.sizes.len() - 1]
    }

    /// Returns the layout of each layer.
    pub fn layers(&self) -> Vec<LayerLayout> {
        let mut start = 0;
        let layout = |pair: &[usize]| {
            let (inputs, outputs) = (pair[0], pair[1]);
            // A layer's rows are the columns of the layer before.
            let step = if start == 0 { ROW_STEP } else { COLUMN_STEP };
            let rows = inputs.next_multiple_of(step);
            let layer = LayerLayout { inputs, outputs, rows, columns: outputs.next_multiple_of(COLUMN_STEP), start };
            start = layer.bias().end;
            layer
        };
        self.sizes.windows(2).map(layout).collect()
    }

    /// Returns weight (inputs × outputs, row-major) and bias of layer `index` without padding.
    pub fn layer(&self, index: usize) -> (Vec<f32>, Vec<f32>) {
        let layer = self.layers()[index];
        let row = |input: usize| &self.parameters[layer.start + input * layer.columns..][..layer.outputs];
        let weight = (0..layer.inputs).flat_map(|input| row(input).to_vec()).collect();
        (weight, self.parameters[layer.bias()][..layer.outputs].to_vec())
    }

    /// Returns the weight (outputs × inputs, as in PyTorch) and the bias of each layer, one after the other.
    pub fn weights(&self) -> Vec<f32> {
        let mut weights = Vec::with_capacity(self.parameters.len());
        for (index, inputs) in self.sizes[..self.sizes.len() - 1].iter().enumerate() {
            let (weight, bias) = self.layer(index);
            weights.extend(transposed(&weight, *inputs));
            weights.extend(bias);
        }
        weights
    }

    /// Creates the network of [`Mlp::weights`]. Returns `None` unless there are [`Mlp::num_weights`] of them.
    pub fn from_weights(sizes: &[usize], mut weights: &[f32]) -> Option<Self> {
        if Some(weights.len()) != Self::num_weights(sizes) {
            return None;
        }
        let mut network = Self::zeros(sizes);
        for (index, pair) in sizes.windows(2).enumerate() {
            let (weight, rest) = weights.split_at(pair[0] * pair[1]);
            let (bias, rest) = rest.split_at(pair[1]);
            network.set_layer(index, &transposed(weight, pair[1]), bias);
            weights = rest;
        }
        Some(network)
    }

    /// Returns the number of weights and biases of a network of these sizes. Returns `None` if a size is zero, or the
    /// number overflows.
    pub fn num_weights(sizes: &[usize]) -> Option<usize> {
        if sizes.len() < 2 || sizes.contains(&0) {
            return None;
        }
        sizes.windows(2).try_fold(0usize, |sum, pair| sum.checked_add(pair[0].checked_add(1)?.checked_mul(pair[1])?))
    }

    /// Returns the number of parameters of a network of these sizes with their padding, which is what it keeps in memory.
    /// Returns `None` if a size is zero, or the number overflows.
    pub fn num_padded(sizes: &[usize]) -> Option<usize> {
        Self::num_weights(sizes)?;
        let padded = |size: &usize, step: usize| size.checked_next_multiple_of(step);
        sizes.windows(2).enumerate().try_fold(0usize, |sum, (index, pair)| {
            let rows = padded(&pair[0], if index == 0 { ROW_STEP } else { COLUMN_STEP })?;
            sum.checked_add(rows.checked_add(1)?.checked_mul(padded(&pair[1], COLUMN_STEP)?)?)
        })
    }

    /// Sets weight (inputs × outputs, row-major) and bias of layer `index`.
    pub fn set_layer(&mut self, index: usize, weight: &[f32], bias: &[f32]) {
        let layer = self.layers()[index];
        assert_eq!((weight.len(), bias.len()), (layer.inputs * layer.outputs, layer.outputs), "size of the layer");
        for (input, row) in weight.chunks_exact(layer.outputs).enumerate() {
            self.parameters[layer.start + input * layer.columns..][..layer.outputs].copy_from_slice(row);
        }
        self.parameters[layer.bias()][..layer.outputs].copy_from_slice(bias);
    }
}

/// Returns the transpose of a row-major matrix with `rows` rows.
pub fn transposed(values: &[f32], rows: usize) -> Vec<f32> {
    let columns = values.len() / rows;
    let mut result = Vec::with_capacity(values.len());
    for column in 0..columns {
        result.extend(values[column..].iter().step_by(columns));
    }
    result
}

/// Returns a matrix with orthonormal rows or columns, whichever are fewer (Gram–Schmidt on normal numbers).
fn orthogonal(rows: usize, columns: usize, random: &mut impl Rng) -> Vec<f32> {
    let (count, len) = (rows.min(columns), rows.max(columns));
    let mut vectors: Vec<Vec<f64>> = Vec::with_capacity(count);
    for _ in 0..count {
        let mut vector: Vec<f64> = (0..len).map(|_| standard_normal(random)).collect();
        for other in &vectors {
            let dot: f64 = vector.iter().zip(other).map(|(one, two)| one * two).sum();
            vector.iter_mut().zip(other).for_each(|(entry, other)| *entry -= dot * other);
        }
        let norm = vector.iter().map(|entry| entry * entry).sum::<f64>().sqrt();
        vectors.push(vector.into_iter().map(|entry| entry / norm).collect());
    }
    let entry = |row: usize, column: usize| if rows < columns { vectors[row][column] } else { vectors[column][row] };
    (0..rows * columns).map(|index| entry(index / columns, index % columns) as f32).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;

    #[test]
    fn initial_weights_are_orthogonal_with_their_gain() {
        let network = Mlp::orthogonal(&[45, 128, 12], 0.01, &mut stream(3, "test", 0));
        let (first, bias) = network.layer(0);
        assert_eq!((first.len(), bias), (45 * 128, vec![0.0; 128]));
        let dot =
            |one: usize, two: usize| -> f32 { (0..128).map(|j| first[one * 128 + j] * first[two * 128 + j]).sum() };
        assert!((dot(7, 7) - 2.0).abs() < 1e-4 && dot(7, 8).abs() < 1e-4);
        let (last, _) = network.layer(1);
        let norm: f32 = (0..128).map(|row| last[row * 12].powi(2)).sum();
        assert!((norm - 1e-4).abs() < 1e-8, "{norm}");
    }

    #[test]
    fn weights_are_read_as_they_were_written_and_refused_if_they_do_not_fit() {
        let network = Mlp::orthogonal(&[3, 5, 2], 1.0, &mut stream(3, "test", 0));
        let weights = network.weights();
        assert_eq!(weights.len(), 3 * 5 + 5 + 5 * 2 + 2);
        assert_eq!(weights[1], network.layer(0).0[5], "the second weight of the first unit is of the second input");
        assert_eq!(Mlp::from_weights(&[3, 5, 2], &weights), Some(network));
        for sizes in [&[3, 5, 3][..], &[37], &[0, 37], &[usize::MAX, usize::MAX]] {
            assert_eq!(Mlp::from_weights(sizes, &weights), None, "{sizes:?}");
        }
        for sizes in [&[3, 5, 2][..], &[45, 1, 700, 1, 12]] {
            assert_eq!(Mlp::num_padded(sizes), Some(Mlp::zeros(sizes).parameters.len()), "{sizes:?}");
        }
    }

    #[test]
    fn layers_are_read_as_they_were_set() {
        let mut network = Mlp::zeros(&[3, 5, 2]);
        let (weight, bias) = ((0..15).map(|i| i as f32).collect::<Vec<_>>(), vec![1.0, 2.0, 3.0, 4.0, 5.0]);
        network.set_layer(0, &weight, &bias);
        assert_eq!(network.layer(0), (weight, bias));
        assert_eq!(network.parameters.iter().filter(|value| **value != 0.0).count(), 14 + 5);
    }
}
