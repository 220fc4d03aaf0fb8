//! Hand-written forward and backward pass of the LSTM over whole sequences, for training on the CPU.
//!
//! burn's automatic differentiation stores every gate of every row as a separate tensor, and its activations are not
//! vectorised. Here burn only multiplies matrices; the rest is plain loops. The tests compare outputs and gradients
//! with burn's.

use burn::tensor::{Device, Tensor, TensorData};

use crate::activation::{sigmoid, tanh};
use crate::sequences::Batch;

/// Parameters of the encoder, as in [`crate::weights::Shape::layout`].
pub struct Encoder {
    /// Weights of the inputs, `[inputs, 4 · hidden]`.
    pub input_weight: Tensor<2>,
    /// Weights of the states, `[hidden, 4 · hidden]`.
    pub hidden_weight: Tensor<2>,
    /// Bias of the gates, `[4 · hidden]`.
    pub bias: Vec<f32>,
}

/// Intermediate results of the forward pass for the backward pass. Every array is ordered by time, then sequence.
pub struct Tape {
    size: usize,
    units: usize,
    /// Gates after the activation, `[time, batch, 4 · hidden]`.
    gates: Vec<f32>,
    /// Cells before the first row and after each row, `[1 + time, batch, hidden]`.
    cells: Vec<f32>,
    /// tanh of the cells after each row, `[time, batch, hidden]`.
    tanh_cells: Vec<f32>,
    /// States before the first row and after each row, `[1 + time, batch, hidden]`.
    states: Vec<f32>,
}

/// Gradients with respect to the parameters of the [`Encoder`].
pub struct Gradients {
    pub input_weight: Tensor<2>,
    pub hidden_weight: Tensor<2>,
    pub bias: Vec<f32>,
}

impl Encoder {
    /// Runs the forward pass over a batch, from states of zero.
    pub fn forward(&self, batch: &Batch) -> Tape {
        let (size, time, [units, width]) = (batch.size, batch.steps, self.hidden_weight.dims());
        let device = self.hidden_weight.device();
        let mut tape = Tape {
            size,
            units,
            gates: to_vec(Tensor::from_data(batch.inputs(), &device).matmul(self.input_weight.clone())),
            cells: vec![0.0; (1 + time) * size * units],
            tanh_cells: vec![0.0; time * size * units],
            states: vec![0.0; (1 + time) * size * units],
        };
        for row in 0..time {
            let before = &tape.states[row * size * units..][..size * units];
            let recurrent = to_vec(matrix(before, [size, units], &device).matmul(self.hidden_weight.clone()));
            let (cells_before, cells) = tape.cells[row * size * units..].split_at_mut(size * units);
            let states = &mut tape.states[(row + 1) * size * units..];
            let tanh_cells = &mut tape.tanh_cells[row * size * units..];
            let gates = &mut tape.gates[row * size * width..];
            for sequence in 0..size {
                let (wide, narrow) = (sequence * width, sequence * units);
                let gates = &mut gates[wide..wide + width];
                for ((gate, recurrent), bias) in gates.iter_mut().zip(&recurrent[wide..wide + width]).zip(&self.bias) {
                    *gate += recurrent + bias;
                }
                forward_step(
                    gates,
                    &cells_before[narrow..narrow + units],
                    &mut cells[narrow..narrow + units],
                    &mut tanh_cells[narrow..narrow + units],
                    &mut states[narrow..narrow + units],
                );
            }
        }
        tape
    }

    /// Returns the gradients of a loss.
    ///
    /// `by_states` are its gradients with respect to the states after each row, `[time · batch, hidden]`.
    pub fn backward(&self, batch: &Batch, tape: &Tape, by_states: &[f32]) -> Gradients {
        let (size, time, [units, width]) = (batch.size, batch.steps, self.hidden_weight.dims());
        let device = self.hidden_weight.device();
        let transposed = self.hidden_weight.clone().transpose();
        let mut by_gates = vec![0.0; time * size * width];
        let mut by_cells = vec![0.0; size * units];
        let mut later = vec![0.0; size * units];
        for row in (0..time).rev() {
            let by_row = &mut by_gates[row * size * width..][..size * width];
            for sequence in 0..size {
                let (wide, narrow) = (sequence * width, sequence * units);
                let at = row * size * units + narrow;
                backward_step(
                    &tape.gates[row * size * width + wide..][..width],
                    [&tape.cells[at..at + units], &tape.tanh_cells[at..at + units]],
                    [&by_states[at..at + units], &later[narrow..narrow + units]],
                    &mut by_cells[narrow..narrow + units],
                    &mut by_row[wide..wide + width],
                );
            }
            if row > 0 {
                later = to_vec(matrix(by_row, [size, width], &device).matmul(transposed.clone()));
            }
        }
        let mut bias = vec![0.0; width];
        for row in by_gates.chunks_exact(width) {
            bias.iter_mut().zip(row).for_each(|(sum, gate)| *sum += gate);
        }
        let states = matrix(&tape.states[..time * size * units], [time * size, units], &device);
        let by_gates = Tensor::from_data(TensorData::new(by_gates, [time * size, width]), &device);
        let inputs = Tensor::<2>::from_data(batch.inputs(), &device);
        Gradients {
            input_weight: inputs.transpose().matmul(by_gates.clone()),
            hidden_weight: states.transpose().matmul(by_gates),
            bias,
        }
    }
}

impl Tape {
    /// Returns the states after each row, `[time · batch, hidden]`.
    pub fn states(&self) -> TensorData {
        let states = self.states[self.size * self.units..].to_vec();
        let rows = states.len() / self.units;
        TensorData::new(states, [rows, self.units])
    }
}

/// Advances one sequence by one row: applies the activations to the gates and computes the next cells and states.
fn forward_step(gates: &mut [f32], before: &[f32], cells: &mut [f32], tanh_cells: &mut [f32], states: &mut [f32]) {
    let units = before.len();
    let (input, rest) = gates.split_at_mut(units);
    let (forget, rest) = rest.split_at_mut(units);
    let (cell, output) = rest.split_at_mut(units);
    for sigmoid_gates in [&mut *input, &mut *forget, &mut *output] {
        for gate in sigmoid_gates {
            *gate = sigmoid(*gate);
        }
    }
    for gate in cell.iter_mut() {
        *gate = tanh(*gate);
    }
    for unit in 0..units {
        cells[unit] = forget[unit] * before[unit] + input[unit] * cell[unit];
    }
    for unit in 0..units {
        tanh_cells[unit] = tanh(cells[unit]);
        states[unit] = output[unit] * tanh_cells[unit];
    }
}

/// Backward pass of [`forward_step`].
///
/// `heads` and `later` are the gradients with respect to the row's states from the heads and from the next row.
/// `by_cells` changes from the gradients with respect to the row's cells to those of the previous row.
fn backward_step(
    gates: &[f32],
    [before, tanh_cells]: [&[f32]; 2],
    [heads, later]: [&[f32]; 2],
    by_cells: &mut [f32],
    by_gates: &mut [f32],
) {
    let units = before.len();
    let (input, rest) = gates.split_at(units);
    let (forget, rest) = rest.split_at(units);
    let (cell, output) = rest.split_at(units);
    let (by_input, rest) = by_gates.split_at_mut(units);
    let (by_forget, rest) = rest.split_at_mut(units);
    let (by_cell, by_output) = rest.split_at_mut(units);
    for unit in 0..units {
        let by_state = heads[unit] + later[unit];
        let by = by_cells[unit] + by_state * output[unit] * (1.0 - tanh_cells[unit] * tanh_cells[unit]);
        by_output[unit] = by_state * tanh_cells[unit] * output[unit] * (1.0 - output[unit]);
        by_input[unit] = by * cell[unit] * input[unit] * (1.0 - input[unit]);
        by_forget[unit] = by * before[unit] * forget[unit] * (1.0 - forget[unit]);
        by_cell[unit] = by * input[unit] * (1.0 - cell[unit] * cell[unit]);
        by_cells[unit] = by * forget[unit];
    }
}

fn matrix(content: &[f32], dimensions: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(content.to_vec(), dimensions), device)
}

fn to_vec(tensor: Tensor<2>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("the elements are f32")
}
