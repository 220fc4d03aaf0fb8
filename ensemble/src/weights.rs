//! Weights of one network, by name.

use std::collections::BTreeMap;

use rand::RngExt;
use twinstep_model::Stream;

/// Weights of one member, row-major, by their names in the file.
pub type Weights = BTreeMap<&'static str, Vec<f32>>;

/// Sizes of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of inputs.
    pub inputs: usize,
    /// Number of units of the encoder and of each head's hidden layer.
    pub hidden: usize,
}

impl Shape {
    /// Returns name and dimensions `[from, to]` of each array. The order of gates is input, forget, cell, output.
    pub fn layout(self) -> [(&'static str, Vec<usize>); 11] {
        let Shape { inputs, hidden } = self;
        [
            ("lstm.input_weight", vec![inputs, 4 * hidden]),
            ("lstm.hidden_weight", vec![hidden, 4 * hidden]),
            ("lstm.bias", vec![4 * hidden]),
            ("mean.hidden.weight", vec![hidden, hidden]),
            ("mean.hidden.bias", vec![hidden]),
            ("mean.weight", vec![hidden, 1]),
            ("mean.bias", vec![1]),
            ("variance.hidden.weight", vec![hidden, hidden]),
            ("variance.hidden.bias", vec![hidden]),
            ("variance.weight", vec![hidden, 1]),
            ("variance.bias", vec![1]),
        ]
    }

    /// Samples initial weights.
    ///
    /// Uniform within ±1/√hidden, as in PyTorch's LSTM. The bias of the forget gates is one higher, so that gradients
    /// propagate over ten rows from the first step of training.
    pub fn random(self, random: &mut Stream) -> Weights {
        let bound = 1.0 / (self.hidden as f32).sqrt();
        let mut weights: Weights = (self.layout().into_iter())
            .map(|(name, shape)| {
                (name, (0..shape.iter().product()).map(|_| random.random_range(-bound..bound)).collect())
            })
            .collect();
        if let Some(bias) = weights.get_mut("lstm.bias") {
            bias[self.hidden..2 * self.hidden].iter_mut().for_each(|forget| *forget += 1.0);
        }
        weights
    }
}
