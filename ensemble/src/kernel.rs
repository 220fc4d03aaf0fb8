//! One row of one network, for as many joints as two registers hold: the two hide each other's waiting.
//!
//! Every joint's sums are taken in one order, inputs before states, whatever the register. Nothing here may stay out of
//! line: it is compiled for the processor's instructions below [`crate::networks`] only.

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]
#![allow(clippy::needless_range_loop, reason = "closures may be left out of line")]

use twinstep_model::NUM_JOINTS;

use crate::activation::{wide_exp, wide_softplus, wide_tanh};
use crate::ensemble::EnsembleMetadata;
use crate::network::VARIANCE_FLOOR;
use crate::weights::Weights;
use crate::wide::Wide;

/// Entries of ξ.
const ERRORS: usize = 2;
/// What weights of the input, forget, cell and output gate are multiplied by: σ(x) = ½ + ½ tanh(x/2), and halves are exact.
const HALVED: [f32; 4] = [0.5, 0.5, 1.0, 0.5];
/// After so many blocks the joints of a block are the same again: 24, 48 and 96 lanes are whole robots.
pub const PATTERNS: usize = 3;

/// One number of each joint of a block.
pub type Pair<W> = [W; 2];

/// A member's numbers, in the order in which they are read.
pub struct Kernel<W> {
    hidden: usize,
    /// `[unit][entry of ξ, then state][gate]`.
    encoder: Vec<[f32; 4]>,
    /// What the gates hear of the joint itself: bias and the input that is 1 for it, `[pattern][unit][gate]`.
    gate_bias: [Vec<[Pair<W>; 4]>; PATTERNS],
    mean: Head,
    variance: Head,
}

/// A hidden layer and an output. Units beyond the last have weights of zero.
struct Head {
    /// `[four units][state][unit]`.
    hidden: Vec<[f32; 4]>,
    /// Bias of the hidden units, and what they weigh in the output: `[four units][unit]`.
    units: Vec<[[f32; 4]; 2]>,
    bias: f32,
}

/// What one member remembers and says of the joints of two registers.
#[derive(Clone)]
pub struct KernelState<W> {
    /// ξ, normalised, and the encoder's states after the last row: what the gates hear.
    pub input: Vec<Pair<W>>,
    pub cells: Vec<Pair<W>>,
    /// Greater than 0 where a row is to be heard; the other joints stay as they are.
    pub active: Pair<W>,
    /// Mean and variance, normalised.
    pub output: [Pair<W>; 2],
    /// Whether any joint is active.
    pub has_input: bool,
    /// Whether an answer is wanted of any joint.
    pub output_needed: bool,
}

/// What is wanted of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heads {
    /// The means.
    Mean,
    /// Means and variances.
    Both,
}

impl<W: Wide> KernelState<W> {
    /// From states of zero.
    pub fn new(hidden: usize) -> Self {
        let zero = [W::splat(0.0); 2];
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

impl<W: Wide> Kernel<W> {
    /// Of a member of an ensemble that is described by `model`.
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
                let mut pairs = [[W::splat(0.0); 2]; 4];
                for lane in 0..2 * W::LANES {
                    let start = start((pattern * 2 * W::LANES + lane) % NUM_JOINTS, unit);
                    for gate in 0..4 {
                        pairs[gate][lane / W::LANES].set(lane % W::LANES, start[gate]);
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

    /// The active joints hear ξ. `room` is for the gates of a unit each.
    #[inline(always)]
    pub fn advance(&self, block: &mut KernelState<W>, pattern: usize, room: &mut [[Pair<W>; 4]]) {
        let KernelState { input: heard, cells, active, .. } = block;
        let units = self.encoder.chunks_exact(ERRORS + self.hidden).zip(&self.gate_bias[pattern]);
        for ((weights, start), sums) in units.zip(room.iter_mut()) {
            let mut gates = *start;
            for (weights, heard) in weights.iter().zip(heard.iter()) {
                for gate in 0..4 {
                    let weight = W::splat(weights[gate]);
                    for half in 0..2 {
                        gates[gate][half] = heard[half].fused(weight, gates[gate][half]);
                    }
                }
            }
            *sums = gates;
        }
        let (one, share) = (W::splat(1.0), W::splat(0.5));
        // Apart from the sums, so that one unit's divisions do not hold up the next one's.
        for ((gates, cell), state) in room.iter().zip(cells.iter_mut()).zip(&mut heard[ERRORS..]) {
            for half in 0..2 {
                // Twice the logistic function of what the gate heard, whose half it is given.
                let [input, forget] = [wide_tanh(gates[0][half]).plus(one), wide_tanh(gates[1][half]).plus(one)];
                let before = cell[half];
                let after = share.times(forget.fused(before, input.times(wide_tanh(gates[2][half]))));
                let output = wide_tanh(gates[3][half]).fused(share, share);
                cell[half] = active[half].select_positive(after, before);
                state[half] = active[half].select_positive(output.times(wide_tanh(after)), state[half]);
            }
        }
    }

    /// What the network says of its joints.
    #[inline(always)]
    pub fn answer(&self, block: &mut KernelState<W>, heads: Heads) {
        let states = &block.input[ERRORS..];
        block.output[0] = self.mean.output(states);
        if heads == Heads::Both {
            let raw = self.variance.output(states);
            let floor = W::splat(VARIANCE_FLOOR as f32);
            block.output[1] = [wide_softplus(raw[0]).plus(floor), wide_softplus(raw[1]).plus(floor)];
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
    fn output<W: Wide>(&self, states: &[Pair<W>]) -> Pair<W> {
        let zero = W::splat(0.0);
        let mut output = [W::splat(self.bias); 2];
        for (weights, [bias, share]) in self.hidden.chunks_exact(states.len()).zip(&self.units) {
            let mut units = [[zero; 2]; 4];
            for unit in 0..4 {
                units[unit] = [W::splat(bias[unit]); 2];
            }
            for (weights, state) in weights.iter().zip(states) {
                for unit in 0..4 {
                    let weight = W::splat(weights[unit]);
                    for half in 0..2 {
                        units[unit][half] = state[half].fused(weight, units[unit][half]);
                    }
                }
            }
            for unit in 0..4 {
                for half in 0..2 {
                    // What is no number is to be seen.
                    output[half] = zero.max(units[unit][half]).fused(W::splat(share[unit]), output[half]);
                }
            }
        }
        output
    }
}

/// How much the members agree: the mean over all pairs of Zᵢⱼ/√(ZᵢᵢZⱼⱼ), whose −log is [`crate::disagreement`].
///
/// `answers` has the mean and the variance of each member, in any unit; each variance is multiplied by `variance_scale`
/// first, and the deviations are left in its place.
#[inline(always)]
pub fn agreement<W: Wide>(answers: &mut [[W; 2]], variance_scale: f32) -> W {
    let (members, minus_half) = (answers.len() as f32, W::splat(-0.5));
    for [_, spread] in answers.iter_mut() {
        *spread = spread.times(W::splat(variance_scale)).sqrt();
    }
    let mut pairs = W::splat(0.0);
    for (index, [mean, deviation]) in answers.iter().enumerate() {
        for [other_mean, other_deviation] in &answers[..index] {
            let variance = deviation.fused(*deviation, other_deviation.times(*other_deviation));
            let share = W::splat(1.0).over(variance);
            let apart = mean.minus(*other_mean);
            let product = deviation.times(*other_deviation);
            let alike = product.plus(product).times(share).sqrt();
            pairs = alike.fused(wide_exp(apart.times(apart).times(share).times(minus_half)), pairs);
        }
    }
    // Each pair counts twice, and each member is its own.
    let sum = pairs.fused(W::splat(2.0), W::splat(members));
    W::splat(1.0).min(sum.times(W::splat(1.0 / (members * members))))
}
