//! Forward and backward pass of a multilayer perceptron for a batch of rows, on SIMD registers.
//!
//! The gradients are those of backpropagation, held to burn's and to finite differences in `tests/it/policy.rs`.

use std::marker::PhantomData;

use twinstep_simd::{InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32};

use crate::matrix::{Left, ROW_STEP, Right, add_product, pack};
use crate::mlp::{LayerLayout, Mlp};

/// A multilayer perceptron whose weights are arranged for the passes.
#[derive(Clone, Debug)]
pub struct Network {
    layers: Vec<PackedLayer>,
    instructions: InstructionSet,
}

#[derive(Clone, Debug)]
struct PackedLayer {
    layout: LayerLayout,
    weight: Vec<f32>,
    /// Transpose of the weight.
    transposed: Vec<f32>,
    bias: Vec<f32>,
}

/// Inputs, units and outputs of a batch of rows, and the gradients with respect to them.
#[derive(Clone, Debug)]
pub struct Activations {
    rows: usize,
    /// Inputs, units of each hidden layer, outputs: `[layer][row][padded unit]`.
    values: Vec<Vec<f32>>,
    /// Gradient with respect to the values of each layer except the inputs.
    gradients: Vec<Vec<f32>>,
    /// Padded number of units of each layer.
    strides: Vec<usize>,
}

impl Activations {
    /// Allocates the activations of `rows` rows of `network`. The number is rounded up.
    pub fn new(network: &Mlp, rows: usize) -> Self {
        let mut activations = Self::forward_only(network, rows);
        let rows = activations.rows;
        activations.gradients = activations.strides[1..].iter().map(|stride| vec![0.0; rows * stride]).collect();
        activations
    }

    /// Allocates activations without gradients, for [`Network::forward`] alone.
    pub fn forward_only(network: &Mlp, rows: usize) -> Self {
        let (layers, rows) = (network.layers(), rows.next_multiple_of(ROW_STEP));
        let strides: Vec<usize> =
            std::iter::once(layers[0].rows).chain(layers.iter().map(|layer| layer.columns)).collect();
        Self {
            rows,
            values: strides.iter().map(|stride| vec![0.0; rows * stride]).collect(),
            gradients: Vec::new(),
            strides,
        }
    }

    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Returns the inputs of a row; those after the last one are padding and must stay zero.
    pub fn input(&mut self, row: usize) -> &mut [f32] {
        let stride = self.strides[0];
        &mut self.values[0][row * stride..][..stride]
    }

    /// Returns the outputs of a row, with padding.
    pub fn output(&self, row: usize) -> &[f32] {
        let last = self.values.len() - 1;
        &self.values[last][row * self.strides[last]..][..self.strides[last]]
    }

    /// Returns the gradient with respect to the outputs of a row; that of the padding must be zero.
    pub fn output_gradient(&mut self, row: usize) -> &mut [f32] {
        let last = self.gradients.len() - 1;
        let stride = self.strides[last + 1];
        &mut self.gradients[last][row * stride..][..stride]
    }
}

impl Network {
    /// Arranges the weights of `network` for the fastest instruction set of this processor.
    pub fn new(network: &Mlp) -> Self {
        Self::with_instructions(network, InstructionSet::best())
    }

    /// Arranges the weights of `network` for [`Network::forward`] alone, in half of the memory.
    pub fn forward_only(network: &Mlp) -> Self {
        Self::arranged(network, InstructionSet::best(), false)
    }

    /// Arranges the weights of `network` for an instruction set.
    pub fn with_instructions(network: &Mlp, instructions: InstructionSet) -> Self {
        Self::arranged(network, instructions, true)
    }

    fn arranged(network: &Mlp, instructions: InstructionSet, has_backward: bool) -> Self {
        let layer = |layout: LayerLayout| PackedLayer {
            weight: vec![0.0; layout.weight().len()],
            transposed: vec![0.0; if has_backward { layout.weight().len() } else { 0 }],
            bias: vec![0.0; layout.columns],
            layout,
        };
        let mut packed = Self { layers: network.layers().into_iter().map(layer).collect(), instructions };
        packed.update(network);
        packed
    }

    /// Copies changed weights of the same network.
    pub fn update(&mut self, network: &Mlp) {
        for (index, layer) in self.layers.iter_mut().enumerate() {
            let LayerLayout { rows, columns, .. } = layer.layout;
            let weight = &network.parameters[layer.layout.weight()];
            pack(weight, rows, columns, &mut layer.weight);
            layer.bias.copy_from_slice(&network.parameters[layer.layout.bias()]);
            // The gradient with respect to the inputs of the first layer is not needed.
            if index > 0 && !layer.transposed.is_empty() {
                let mut transposed = vec![0.0; weight.len()];
                for (row, entries) in weight.chunks_exact(columns).enumerate() {
                    for (column, entry) in entries.iter().enumerate() {
                        transposed[column * rows + row] = *entry;
                    }
                }
                pack(&transposed, columns, rows, &mut layer.transposed);
            }
        }
    }

    /// Computes the outputs of the first `rows` rows from their inputs.
    pub fn forward(&self, activations: &mut Activations, rows: usize) {
        let rows = rows.next_multiple_of(ROW_STEP);
        with_f32(self.instructions, Forward { layers: &self.layers, activations, rows });
    }

    /// Adds the gradient with respect to the parameters to `gradient`, from the gradient with respect to the outputs.
    ///
    /// `activations` are those of [`Network::forward`] with as many rows. `gradient` has the layout of
    /// [`Mlp::parameters`].
    pub fn backward(&self, activations: &mut Activations, rows: usize, gradient: &mut [f32]) {
        let rows = rows.next_multiple_of(ROW_STEP);
        with_f32(self.instructions, Backward { layers: &self.layers, activations, rows, gradient });
    }
}

struct Forward<'a> {
    layers: &'a [PackedLayer],
    activations: &'a mut Activations,
    rows: usize,
}

struct Backward<'a> {
    layers: &'a [PackedLayer],
    activations: &'a mut Activations,
    rows: usize,
    gradient: &'a mut [f32],
}

/// A pass on registers of type `T`.
struct OnRegisters<T, P>(P, PhantomData<T>);

impl SimdTask for Forward<'_> {
    type Output = ();

    fn run<T: SimdFloat>(self) {
        T::vectorise(OnRegisters::<T, _>(self, PhantomData));
    }
}

impl SimdTask for Backward<'_> {
    type Output = ();

    fn run<T: SimdFloat>(self) {
        T::vectorise(OnRegisters::<T, _>(self, PhantomData));
    }
}

impl<T: SimdFloat> SimdKernel for OnRegisters<T, Forward<'_>> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Forward { layers, activations, rows } = self.0;
        for (index, layer) in layers.iter().enumerate() {
            let LayerLayout { columns, rows: inputs, .. } = layer.layout;
            let (before, after) = activations.values.split_at_mut(index + 1);
            let (x, y) = (&before[index], &mut after[0][..rows * columns]);
            for row in y.chunks_exact_mut(columns) {
                row.copy_from_slice(&layer.bias);
            }
            let left = Left { values: x, stride: inputs, is_transposed: false };
            let right = Right { values: &layer.weight, rows: inputs, columns, is_packed: true };
            add_product::<T>(left, right, rows, y);
            if index + 1 < layers.len() {
                rectify::<T>(y);
            }
        }
    }
}

impl<T: SimdFloat> SimdKernel for OnRegisters<T, Backward<'_>> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Backward { layers, activations, rows, gradient } = self.0;
        for (index, layer) in layers.iter().enumerate().rev() {
            let LayerLayout { columns, rows: inputs, .. } = layer.layout;
            let (before, after) = activations.gradients.split_at_mut(index);
            let (x, dy) = (&activations.values[index], &after[0][..rows * columns]);
            for row in dy.chunks_exact(columns) {
                add_to::<T>(&mut gradient[layer.layout.bias()], row);
            }
            let left = Left { values: x, stride: inputs, is_transposed: true };
            let right = Right { values: dy, rows, columns, is_packed: false };
            add_product::<T>(left, right, inputs, &mut gradient[layer.layout.weight()]);
            if index > 0 {
                let dx = &mut before[index - 1][..rows * inputs];
                dx.fill(0.0);
                let left = Left { values: dy, stride: columns, is_transposed: false };
                let right = Right { values: &layer.transposed, rows: columns, columns: inputs, is_packed: true };
                add_product::<T>(left, right, rows, dx);
                zero_where_inactive::<T>(dx, &x[..rows * inputs]);
            }
        }
    }
}

/// Replaces negative values by zero.
#[inline(always)]
fn rectify<T: SimdFloat>(values: &mut [f32]) {
    let zero = T::splat(0.0);
    for chunk in values.chunks_exact_mut(T::LANES) {
        T::load(chunk).max(zero).store(chunk);
    }
}

/// Sets the gradient of units whose value is zero to zero.
#[inline(always)]
fn zero_where_inactive<T: SimdFloat>(gradient: &mut [f32], values: &[f32]) {
    let zero = T::splat(0.0);
    for (gradient, values) in gradient.chunks_exact_mut(T::LANES).zip(values.chunks_exact(T::LANES)) {
        zero.select_lt(T::load(values), T::load(gradient), zero).store(gradient);
    }
}

#[inline(always)]
fn add_to<T: SimdFloat>(sum: &mut [f32], values: &[f32]) {
    for (sum, values) in sum.chunks_exact_mut(T::LANES).zip(values.chunks_exact(T::LANES)) {
        (T::load(sum) + T::load(values)).store(sum);
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use twinstep_model::stream;

    use super::*;

    /// Returns the gradient of Σ weightᵢ · outputᵢ over all rows by the backward pass.
    fn gradient_of(network: &Mlp, instructions: InstructionSet, inputs: &[Vec<f32>]) -> (f64, Vec<f32>) {
        let packed = Network::with_instructions(network, instructions);
        let mut activations = Activations::new(network, inputs.len());
        for (row, input) in inputs.iter().enumerate() {
            activations.input(row)[..input.len()].copy_from_slice(input);
        }
        packed.forward(&mut activations, inputs.len());
        let mut loss = 0.0;
        for row in 0..inputs.len() {
            for output in 0..network.outputs() {
                let weight = ((row + 3 * output) as f32).sin();
                loss += f64::from(weight * activations.output(row)[output]);
                activations.output_gradient(row)[output] = weight;
            }
        }
        let mut gradient = vec![0.0; network.parameters.len()];
        packed.backward(&mut activations, inputs.len(), &mut gradient);
        (loss, gradient)
    }

    fn example() -> (Mlp, Vec<Vec<f32>>) {
        let mut random = stream(5, "network", 0);
        let mut network = Mlp::orthogonal(&[7, 20, 33, 3], 1.0, &mut random);
        for index in 0..network.layers().len() {
            let (weight, bias) = network.layer(index);
            network.set_layer(index, &weight, &bias.iter().map(|_| random.random::<f32>() - 0.5).collect::<Vec<_>>());
        }
        let inputs = (0..16).map(|_| (0..7).map(|_| 2.0 * random.random::<f32>() - 1.0).collect()).collect();
        (network, inputs)
    }

    #[test]
    fn gradient_agrees_with_finite_differences() {
        let (network, inputs) = example();
        let (_, gradient) = gradient_of(&network, InstructionSet::best(), &inputs);
        let mut checked = 0;
        for index in (0..network.parameters.len()).step_by(7) {
            let loss = |offset: f32| {
                let mut other = network.clone();
                other.parameters[index] += offset;
                gradient_of(&other, InstructionSet::best(), &inputs).0
            };
            if gradient[index] != 0.0 {
                let difference = (loss(1e-3) - loss(-1e-3)) / 2e-3;
                // A unit that switches within the step of 1e-3 leaves a part of its gradient.
                assert!((difference - f64::from(gradient[index])).abs() < 0.02, "{index}: {difference} {gradient:?}");
                checked += 1;
            }
        }
        assert!(checked > 50, "{checked}");
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits_and_padding_has_no_gradient() {
        let (network, inputs) = example();
        let expected = gradient_of(&network, InstructionSet::PORTABLE, &inputs);
        for instructions in InstructionSet::available() {
            assert_eq!(gradient_of(&network, instructions, &inputs), expected, "{instructions}");
        }
        let mut unpadded = Mlp::zeros(network.sizes());
        let mut all = network.clone();
        all.parameters.clone_from(&expected.1);
        for index in 0..network.layers().len() {
            let (weight, bias) = all.layer(index);
            unpadded.set_layer(index, &weight, &bias);
        }
        assert_eq!(unpadded.parameters, expected.1);
    }

    #[test]
    fn rows_do_not_depend_on_their_neighbours() {
        let (network, inputs) = example();
        let packed = Network::new(&network);
        let outputs = |inputs: &[Vec<f32>]| {
            let mut activations = Activations::new(&network, inputs.len());
            for (row, input) in inputs.iter().enumerate() {
                activations.input(row)[..7].copy_from_slice(input);
            }
            packed.forward(&mut activations, inputs.len());
            (0..inputs.len()).map(|row| activations.output(row)[..3].to_vec()).collect::<Vec<_>>()
        };
        let together = outputs(&inputs);
        for (input, expected) in inputs.iter().zip(together) {
            assert_eq!(outputs(std::slice::from_ref(input)), [expected]);
        }
    }
}
