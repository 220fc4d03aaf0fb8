//! One row of one network, for the joints of two SIMD registers. Two registers hide the latency of the instructions.
//!
//! The order of the sums does not depend on the register: inputs before states. All functions must be inlined, because
//! only their callers in `member_batch` are compiled for the instruction set of the processor.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "closures may not be inlined")]

use twinstep_model::NUM_JOINTS;

use crate::activation::{wide_exp, wide_softplus, wide_tanh};
use crate::metadata::EnsembleMetadata;
use crate::network::VARIANCE_FLOOR;
use crate::weights::Weights;
use twinstep_simd::SimdFloat;

/// Number of entries of ξ.
const ERRORS: usize = 2;
/// Factors on the weights of the input, forget, cell and output gate: σ(x) = ½ + ½ tanh(x/2). Halving is exact.
const HALVED: [f32; 4] = [0.5, 0.5, 1.0, 0.5];
/// Number of blocks after which the assignment of joints to lanes repeats: 24, 48 or 96 lanes are whole robots.
pub const PATTERNS: usize = 3;

/// One number per joint of a block.
pub type Pair<T> = [T; 2];

/// Parameters of a member, in the order in which they are read.
pub struct Kernel<T> {
    hidden: usize,
    /// Weights of the encoder, `[unit][entry of ξ, then state][gate]`.
    encoder: Vec<[f32; 4]>,
    /// Bias of the gates and weight of the joint's one-hot input, `[pattern][unit][gate]`.
    gate_bias: [Vec<[Pair<T>; 4]>; PATTERNS],
    mean: Head,
    variance: Head,
}

/// A hidden layer and an output. The units are padded to a multiple of four with weights of zero.
struct Head {
    /// Weights of the hidden layer, `[four units][state][unit]`.
    hidden: Vec<[f32; 4]>,
    /// Bias of the hidden units and their weights in the output, `[four units][unit]`.
    units: Vec<[[f32; 4]; 2]>,
    bias: f32,
}

/// Input, state and output of one member for the joints of two registers.
#[derive(Clone)]
pub struct KernelState<T> {
    /// Inputs of the gates: normalised ξ, and the encoder's states after the last row.
    pub input: Vec<Pair<T>>,
    pub cells: Vec<Pair<T>>,
    /// Greater than 0 for joints that have an input. The states of the others do not change.
    pub active: Pair<T>,
    /// Normalised mean and variance.
    pub output: [Pair<T>; 2],
    /// True if any joint is active.
    pub has_input: bool,
    /// True if the output of any joint is needed.
    pub output_needed: bool,
}

/// Heads of a network to evaluate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heads {
    /// Means only.
    Mean,
    /// Means and variances.
    Both,
}

impl<T: SimdFloat> KernelState<T> {
    /// Creates states of zero.
    pub fn new(hidden: usize) -> Self {
        let zero = [T::splat(0.0); 2];
        Self {
            input: vec![zero; ERRORS + hidden],
            cells: vec![zero; hidden],
            active: zero,
            output: [zero; 2],
            has_input: false,
            output_needed: false,
        }
    }
}

impl<T: SimdFloat> Kernel<T> {
    /// Arranges the weights of a member of the ensemble `model`.
    pub fn new(model: &EnsembleMetadata, weights: &Weights) -> Self {
        let (hidden, width) = (model.hidden, 4 * model.hidden);
        let [input, recurrent, bias] =
            ["lstm.input_weight", "lstm.hidden_weight", "lstm.bias"].map(|name| &weights[name]);
        let gates = |array: &[f32], row: usize, unit: usize| -> [f32; 4] {
            std::array::from_fn(|gate| HALVED[gate] * array[row * width + gate * hidden + unit])
        };
        let encoder = (0..hidden).flat_map(|unit| {
            let errors = (0..ERRORS).map(move |row| gates(input, row, unit));
            errors.chain((0..hidden).map(move |row| gates(recurrent, row, unit)))
        });
        let start = |joint: usize, unit: usize| {
            let own = model.one_hot_index(joint).map_or([0.0; 4], |row| gates(input, ERRORS + row, unit));
            let bias = gates(bias, 0, unit);
            std::array::from_fn::<f32, 4, _>(|gate| bias[gate] + own[gate])
        };
        let gate_bias = std::array::from_fn(|pattern| {
            let of_unit = |unit| {
                let mut pairs = [[T::splat(0.0); 2]; 4];
                for lane in 0..2 * T::LANES {
                    let start = start((pattern * 2 * T::LANES + lane) % NUM_JOINTS, unit);
                    for gate in 0..4 {
                        pairs[gate][lane / T::LANES].set(lane % T::LANES, f64::from(start[gate]));
                    }
                }
                pairs
            };
            (0..hidden).map(of_unit).collect()
        });
        Self {
            hidden,
            encoder: encoder.collect(),
            gate_bias,
            mean: Head::new(hidden, ["mean.hidden.weight", "mean.hidden.bias", "mean.weight", "mean.bias"], weights),
            variance: Head::new(
                hidden,
                ["variance.hidden.weight", "variance.hidden.bias", "variance.weight", "variance.bias"],
                weights,
            ),
        }
    }

    /// Advances the active joints by one row. `room` is a workspace for the gates of each unit.
    #[inline(always)]
    pub fn advance(&self, block: &mut KernelState<T>, pattern: usize, room: &mut [[Pair<T>; 4]]) {
        let KernelState { input: inputs, cells, active, .. } = block;
        let units = self.encoder.chunks_exact(ERRORS + self.hidden).zip(&self.gate_bias[pattern]);
        for ((weights, start), sums) in units.zip(room.iter_mut()) {
            let mut gates = *start;
            for (weights, inputs) in weights.iter().zip(inputs.iter()) {
                for gate in 0..4 {
                    let weight = T::splat(f64::from(weights[gate]));
                    for half in 0..2 {
                        gates[gate][half] = inputs[half].mul_add(weight, gates[gate][half]);
                    }
                }
            }
            *sums = gates;
        }
        let (zero, one, share) = (T::splat(0.0), T::splat(1.0), T::splat(0.5));
        // A separate loop, so that the divisions of the units overlap.
        for ((gates, cell), state) in room.iter().zip(cells.iter_mut()).zip(&mut inputs[ERRORS..]) {
            for half in 0..2 {
                // Twice the logistic function, because the weights of these gates are halved.
                let [input, forget] = [wide_tanh(gates[0][half]) + one, wide_tanh(gates[1][half]) + one];
                let before = cell[half];
                let after = share * forget.mul_add(before, input * wide_tanh(gates[2][half]));
                let output = wide_tanh(gates[3][half]).mul_add(share, share);
                cell[half] = zero.select_lt(active[half], after, before);
                state[half] = zero.select_lt(active[half], output * wide_tanh(after), state[half]);
            }
        }
    }

    /// Evaluates the heads.
    #[inline(always)]
    pub fn answer(&self, block: &mut KernelState<T>, heads: Heads) {
        let states = &block.input[ERRORS..];
        block.output[0] = self.mean.output(states);
        if heads == Heads::Both {
            let raw = self.variance.output(states);
            let floor = T::splat(VARIANCE_FLOOR);
            block.output[1] = [wide_softplus(raw[0]) + floor, wide_softplus(raw[1]) + floor];
        }
    }
}

impl Head {
    fn new(hidden: usize, [layer, layer_bias, weight, bias]: [&str; 4], weights: &Weights) -> Self {
        let of = |array: &[f32], row: usize, four: usize| -> [f32; 4] {
            let unit = |index: usize| 4 * four + index;
            std::array::from_fn(|index| if unit(index) < hidden { array[row * hidden + unit(index)] } else { 0.0 })
        };
        let fours = 0..hidden.div_ceil(4);
        let rows = |four| (0..hidden).map(move |row| of(&weights[layer], row, four));
        let units = fours.clone().map(|four| [of(&weights[layer_bias], 0, four), of(&weights[weight], 0, four)]);
        Self { hidden: fours.clone().flat_map(rows).collect(), units: units.collect(), bias: weights[bias][0] }
    }

    #[inline(always)]
    fn output<T: SimdFloat>(&self, states: &[Pair<T>]) -> Pair<T> {
        let zero = T::splat(0.0);
        let mut output = [T::splat(f64::from(self.bias)); 2];
        for (weights, [bias, share]) in self.hidden.chunks_exact(states.len()).zip(&self.units) {
            let mut units = [[zero; 2]; 4];
            for unit in 0..4 {
                units[unit] = [T::splat(f64::from(bias[unit])); 2];
            }
            for (weights, state) in weights.iter().zip(states) {
                for unit in 0..4 {
                    let weight = T::splat(f64::from(weights[unit]));
                    for half in 0..2 {
                        units[unit][half] = state[half].mul_add(weight, units[unit][half]);
                    }
                }
            }
            for unit in 0..4 {
                for half in 0..2 {
                    // `max` returns its first operand if it is NaN, so that NaN propagates.
                    output[half] = units[unit][half].max(zero).mul_add(T::splat(f64::from(share[unit])), output[half]);
                }
            }
        }
        output
    }
}

/// Returns the mean over all pairs of Zᵢⱼ/√(ZᵢᵢZⱼⱼ), whose −log is [`crate::epistemic_uncertainty`].
///
/// `outputs` contains the mean and the variance of each member, in any unit. Each variance is first multiplied by
/// `variance_scale`, and replaced by the standard deviation.
#[inline(always)]
pub fn agreement<T: SimdFloat>(outputs: &mut [[T; 2]], variance_scale: f32) -> T {
    let (members, minus_half) = (outputs.len() as f32, T::splat(-0.5));
    for [_, variance] in outputs.iter_mut() {
        *variance = (*variance * T::splat(f64::from(variance_scale))).sqrt();
    }
    let mut pairs = T::splat(0.0);
    for (index, [mean, std]) in outputs.iter().enumerate() {
        for [other_mean, other_std] in &outputs[..index] {
            let variance = std.mul_add(*std, *other_std * *other_std);
            let share = T::splat(1.0) / variance;
            let difference = *mean - *other_mean;
            let product = *std * *other_std;
            let normaliser = ((product + product) * share).sqrt();
            pairs = normaliser.mul_add(wide_exp(difference * difference * share * minus_half), pairs);
        }
    }
    // Each pair counts twice, and each member forms a pair with itself.
    let sum = pairs.mul_add(T::splat(2.0), T::splat(f64::from(members)));
    T::splat(1.0).min(sum * T::splat(f64::from(1.0 / (members * members))))
}
