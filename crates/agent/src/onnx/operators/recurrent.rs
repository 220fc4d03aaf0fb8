//! Recurrent layers: LSTM, GRU and the plain one, as ONNX defines them (operators LSTM, GRU, RNN of set 14).

use super::Operation;
use super::elementwise::recurrent_activation;
use super::product::product_transposed;
use crate::onnx::tensor::{Tensor, len};

type Outputs = Result<Vec<Tensor>, String>;
type Activation = Box<dyn Fn(f32) -> f32>;

/// Most numbers that a layer computes.
const MAX_NUMBERS: usize = 1 << 24;

/// Evaluates an operation of this family. Returns `None` for another one.
pub fn evaluate(operation: &Operation) -> Option<Outputs> {
    match operation.node.operator.as_str() {
        "LSTM" => Some(run(operation, 4, &["Sigmoid", "Tanh", "Tanh"])),
        "GRU" => Some(run(operation, 3, &["Sigmoid", "Tanh"])),
        "RNN" => Some(run(operation, 1, &["Tanh"])),
        _ => None,
    }
}

/// Weights of one direction.
struct Layer<'a> {
    /// Lengths of input and state.
    sizes: [usize; 2],
    gates: usize,
    /// Weights of the input and of the state: gates · state × input, gates · state × state.
    weights: [&'a [f32]; 2],
    /// Biases of both: gates · state.
    biases: [Vec<f32>; 2],
    activations: Vec<Activation>,
    /// GRU: the reset gate acts on the product with the state.
    is_linear_before_reset: bool,
}

fn run(operation: &Operation, gates: usize, activations: &[&str]) -> Outputs {
    let x = operation.input(0)?;
    let [steps, batch, input] = x.shape[..] else {
        return Err(format!("has an input with the dimensions {:?}; three are expected", x.shape));
    };
    if operation.integer("layout", 0) != 0
        || operation.optional(4).is_some()
        || operation.node.attributes.contains_key("clip")
        || operation.integer("input_forget", 0) != 0
    {
        return Err("with `layout` 1, `sequence_lens`, `clip` or `input_forget` is not supported".to_owned());
    }
    let (w, r) = (operation.input(1)?, operation.input(2)?);
    let [directions, rows, hidden] = r.shape[..] else {
        return Err(format!("has weights with the dimensions {:?}", r.shape));
    };
    if hidden == 0 || rows != gates * hidden || w.shape != [directions, rows, input] {
        return Err(format!("has weights with the dimensions {:?} and {:?}", w.shape, r.shape));
    }
    let total = [steps, directions, batch, rows].iter().try_fold(1usize, |product, len| product.checked_mul(*len));
    if total.is_none_or(|total| total > MAX_NUMBERS) {
        return Err("has too large arrays".to_owned());
    }
    let is_reversed = match (operation.text("direction").unwrap_or("forward"), directions) {
        ("forward", 1) => vec![false],
        ("reverse", 1) => vec![true],
        ("bidirectional", 2) => vec![false, true],
        (direction, _) => return Err(format!("has the direction `{direction}` with {directions} sets of weights")),
    };
    let states = [state(operation, 5, [directions, batch, hidden])?, state(operation, 6, [directions, batch, hidden])?];
    let mut outputs = vec![0.0; len(&[steps, directions, batch, hidden])?];
    let [mut last_h, mut last_c] = states;
    for (direction, reversed) in is_reversed.into_iter().enumerate() {
        let layer = Layer::new(operation, direction, [input, hidden], gates, activations)?;
        for lane in 0..batch {
            let own = (direction * batch + lane) * hidden..(direction * batch + lane + 1) * hidden;
            let (mut h, mut c) = (last_h[own.clone()].to_vec(), last_c[own.clone()].to_vec());
            for step in 0..steps {
                let time = if reversed { steps - 1 - step } else { step };
                layer.step(&x.as_floats()?[(time * batch + lane) * input..][..input], &mut h, &mut c);
                outputs[((time * directions + direction) * batch + lane) * hidden..][..hidden].copy_from_slice(&h);
            }
            last_h[own.clone()].copy_from_slice(&h);
            last_c[own].copy_from_slice(&c);
        }
    }
    let shape = vec![directions, batch, hidden];
    let mut all =
        vec![Tensor::floats(vec![steps, directions, batch, hidden], outputs)?, Tensor::floats(shape.clone(), last_h)?];
    if gates == 4 {
        all.push(Tensor::floats(shape, last_c)?);
    }
    Ok(all)
}

fn state(operation: &Operation, index: usize, shape: [usize; 3]) -> Result<Vec<f32>, String> {
    match operation.optional(index) {
        Some(state) if state.shape == shape => state.as_floats().map(<[f32]>::to_vec),
        Some(state) => Err(format!("has a state with the dimensions {:?}; {shape:?} are expected", state.shape)),
        None => Ok(vec![0.0; len(&shape)?]),
    }
}

impl<'a> Layer<'a> {
    fn new(
        operation: &Operation<'a>,
        direction: usize,
        sizes: [usize; 2],
        gates: usize,
        defaults: &[&str],
    ) -> Result<Self, String> {
        let [input, hidden] = sizes;
        let rows = gates * hidden;
        let biases = match operation.optional(3) {
            Some(b) => {
                let both = b.as_floats()?.get(direction * 2 * rows..(direction + 1) * 2 * rows);
                let both = both.ok_or_else(|| format!("has a bias with the dimensions {:?}", b.shape))?;
                [both[..rows].to_vec(), both[rows..].to_vec()]
            }
            None => [vec![0.0; rows], vec![0.0; rows]],
        };
        // One direction has all names; another one follows.
        let names = operation.node.attributes.get("activations").map_or(&[][..], |names| &names.texts);
        let names = names.get(direction * defaults.len()..).unwrap_or_default();
        let name = |index: usize| names.get(index).map_or(defaults[index], String::as_str);
        let activations: Option<Vec<Activation>> =
            (0..defaults.len()).map(|index| recurrent_activation(name(index), &[])).collect();
        Ok(Self {
            sizes,
            gates,
            weights: [
                &operation.input(1)?.as_floats()?[direction * rows * input..][..rows * input],
                &operation.input(2)?.as_floats()?[direction * rows * hidden..][..rows * hidden],
            ],
            biases,
            activations: activations.ok_or("has an activation that is not supported")?,
            is_linear_before_reset: operation.integer("linear_before_reset", 0) != 0,
        })
    }

    /// Advances the state by one step.
    fn step(&self, x: &[f32], h: &mut Vec<f32>, c: &mut [f32]) {
        let [input, hidden] = self.sizes;
        let rows = self.gates * hidden;
        let of_input = product_transposed(x, self.weights[0], [1, input, rows]);
        let of_state = product_transposed(h, self.weights[1], [1, hidden, rows]);
        let from_input =
            |gate: usize, unit: usize| of_input[gate * hidden + unit] + self.biases[0][gate * hidden + unit];
        let from_state =
            |gate: usize, unit: usize| of_state[gate * hidden + unit] + self.biases[1][gate * hidden + unit];
        let sum = |gate: usize, unit: usize| from_input(gate, unit) + from_state(gate, unit);
        let f = |index: usize, value: f32| self.activations[index](value);
        match self.gates {
            // Gates: input, output, forget, cell.
            4 => {
                for unit in 0..hidden {
                    c[unit] = f(0, sum(2, unit)) * c[unit] + f(0, sum(0, unit)) * f(1, sum(3, unit));
                    h[unit] = f(0, sum(1, unit)) * f(2, c[unit]);
                }
            }
            // Gates: update, reset, hidden.
            3 => {
                let update: Vec<f32> = (0..hidden).map(|unit| f(0, sum(0, unit))).collect();
                let reset: Vec<f32> = (0..hidden).map(|unit| f(0, sum(1, unit))).collect();
                let candidates: Vec<f32> = if self.is_linear_before_reset {
                    (0..hidden).map(|unit| f(1, from_input(2, unit) + reset[unit] * from_state(2, unit))).collect()
                } else {
                    let gated: Vec<f32> = h.iter().zip(&reset).map(|(h, reset)| h * reset).collect();
                    let weights = &self.weights[1][2 * hidden * hidden..];
                    let product = product_transposed(&gated, weights, [1, hidden, hidden]);
                    let bias = &self.biases[1][2 * hidden..];
                    (0..hidden).map(|unit| f(1, from_input(2, unit) + product[unit] + bias[unit])).collect()
                };
                for unit in 0..hidden {
                    h[unit] = (1.0 - update[unit]) * candidates[unit] + update[unit] * h[unit];
                }
            }
            _ => *h = (0..hidden).map(|unit| f(0, sum(0, unit))).collect(),
        }
    }
}
