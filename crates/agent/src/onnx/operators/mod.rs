//! Operators of ONNX that networks of policies consist of, as operator sets 11 to 20 define them.
//!
//! - [`elementwise`]: one entry of the result from one entry of each input.
//! - [`layout`]: the same entries in another order or shape.
//! - [`reduction`]: sums, means, extremes, normalisation along dimensions.
//! - [`product`]: matrix products and convolutions.
//! - [`recurrent`]: LSTM, GRU and the plain recurrent layer.

mod elementwise;
mod layout;
mod product;
mod recurrent;
mod reduction;
#[cfg(test)]
mod tests;

use crate::onnx::graph::Node;
use crate::onnx::tensor::Tensor;

/// Inputs of an operation; `None` for an optional one that is left out.
type Inputs<'a> = [Option<&'a Tensor>];

/// Returns the outputs of an operation. The error continues a sentence with the name of the operator.
pub fn evaluate(node: &Node, inputs: &Inputs) -> Result<Vec<Tensor>, String> {
    let operation = Operation { node, inputs };
    for family in [elementwise::evaluate, layout::evaluate, reduction::evaluate, product::evaluate, recurrent::evaluate]
    {
        if let Some(outputs) = family(&operation) {
            return outputs;
        }
    }
    Err("is not supported: it is none of those of feed-forward, convolutional and recurrent networks".to_owned())
}

/// An operation with its inputs.
struct Operation<'a> {
    node: &'a Node,
    inputs: &'a Inputs<'a>,
}

impl<'a> Operation<'a> {
    fn optional(&self, index: usize) -> Option<&'a Tensor> {
        self.inputs.get(index).copied().flatten()
    }

    fn input(&self, index: usize) -> Result<&'a Tensor, String> {
        self.optional(index).ok_or_else(|| format!("has no input {index}"))
    }

    fn float(&self, name: &str, default: f32) -> f32 {
        self.node.attributes.get(name).and_then(|one| one.float).unwrap_or(default)
    }

    fn integer(&self, name: &str, default: i64) -> i64 {
        self.node.attributes.get(name).and_then(|one| one.integer).unwrap_or(default)
    }

    fn text(&self, name: &str) -> Option<&str> {
        self.node.attributes.get(name).and_then(|one| one.text.as_deref())
    }

    /// Returns integers that are an attribute, or an input in newer files. `None`: neither is given.
    fn integers(&self, name: &str, index: usize) -> Result<Option<Vec<i64>>, String> {
        match self.optional(index) {
            Some(tensor) => tensor.as_integers().map(|numbers| Some(numbers.to_vec())),
            None => Ok(self.node.attributes.get(name).map(|one| one.integers.clone())),
        }
    }
}
