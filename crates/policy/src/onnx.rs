//! Export of a policy to ONNX, for runtimes in other languages.
//!
//! The graph has one input `obs` (batch × observation, SI units, as the environment returns it) and one output `action`
//! (batch × action, mean, not clipped). The normaliser is inside. The format is Protocol Buffers; the field numbers are
//! those of `onnx.proto`, version 1.17.

use std::path::Path;

use crate::array_file::{ArrayFileError, write_atomically};
use crate::normaliser::CLIP;
use crate::policy::Policy;

/// Version of the ONNX format, and of its operators. Older runtimes reject newer formats.
const IR_VERSION: u64 = 8;
const OPSET: u64 = 17;
/// `TensorProto.DataType.FLOAT`.
const FLOAT: u64 = 1;

impl Policy {
    /// Writes the policy as an ONNX model. The write is atomic.
    pub fn write_onnx(&self, path: impl AsRef<Path>) -> Result<(), ArrayFileError> {
        write_atomically(path.as_ref(), &self.onnx())
    }

    fn onnx(&self) -> Vec<u8> {
        let (mean, std) = self.normaliser.mean_and_std();
        let mut graph = Message::default();
        for (inputs, operator, output) in
            [(["obs", "mean"], "Sub", "centred"), (["centred", "std"], "Div", "normalised")]
        {
            graph.message(1, &node(&inputs, operator, output));
        }
        graph.message(1, &node(&["normalised", "lowest", "highest"], "Clip", "unit_0"));
        let layers = self.actor.layers();
        for index in 0..layers.len() {
            let is_last = index + 1 == layers.len();
            let names = [format!("unit_{index}"), format!("weight_{index}"), format!("bias_{index}")];
            let product = if is_last { "action".to_owned() } else { format!("product_{index}") };
            graph.message(1, &node(&names.each_ref().map(String::as_str), "Gemm", &product));
            if !is_last {
                graph.message(1, &node(&[&product], "Relu", &format!("unit_{}", index + 1)));
            }
        }
        graph.text(2, "policy");
        let obs_len = mean.len();
        for (name, dimensions, values) in [
            ("mean", vec![obs_len], &mean),
            ("std", vec![obs_len], &std),
            ("lowest", vec![], &vec![-CLIP]),
            ("highest", vec![], &vec![CLIP]),
        ] {
            graph.message(5, &tensor(name, &dimensions, values));
        }
        for (index, layer) in layers.iter().enumerate() {
            let (weight, bias) = self.actor.layer(index);
            graph.message(5, &tensor(&format!("weight_{index}"), &[layer.inputs, layer.outputs], &weight));
            graph.message(5, &tensor(&format!("bias_{index}"), &[layer.outputs], &bias));
        }
        graph.message(11, &value("obs", obs_len));
        graph.message(12, &value("action", self.actor.outputs()));

        let mut model = Message::default();
        model.integer(1, IR_VERSION);
        model.text(2, "twinstep");
        model.message(7, &graph);
        let mut operators = Message::default();
        operators.text(1, "");
        operators.integer(2, OPSET);
        model.message(8, &operators);
        let spec = serde_json::to_string(&self.spec).expect("a spec is plain data");
        for (key, text) in [("spec_hash", self.spec.hash()), ("spec", spec)] {
            let mut property = Message::default();
            property.text(1, key);
            property.text(2, &text);
            model.message(14, &property);
        }
        model.0
    }
}

fn node(inputs: &[&str], operator: &str, output: &str) -> Message {
    let mut node = Message::default();
    for input in inputs {
        node.text(1, input);
    }
    node.text(2, output);
    node.text(3, output);
    node.text(4, operator);
    node
}

fn tensor(name: &str, dimensions: &[usize], values: &[f32]) -> Message {
    let mut tensor = Message::default();
    for len in dimensions {
        tensor.integer(1, *len as u64);
    }
    tensor.integer(2, FLOAT);
    tensor.text(8, name);
    tensor.bytes(9, &values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<_>>());
    tensor
}

/// Returns the description of an input or output: `batch` rows of `len` numbers.
fn value(name: &str, len: usize) -> Message {
    let [mut batch, mut columns, mut shape, mut tensor, mut kind, mut value] = <[Message; 6]>::default();
    batch.text(2, "batch");
    columns.integer(1, len as u64);
    shape.message(1, &batch);
    shape.message(1, &columns);
    tensor.integer(1, FLOAT);
    tensor.message(2, &shape);
    kind.message(1, &tensor);
    value.text(1, name);
    value.message(2, &kind);
    value
}

/// A message of Protocol Buffers.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut number: u64) {
        while number >= 0x80 {
            self.0.push(number as u8 | 0x80);
            number >>= 7;
        }
        self.0.push(number as u8);
    }

    fn integer(&mut self, field: u64, number: u64) {
        self.varint(field << 3);
        self.varint(number);
    }

    fn bytes(&mut self, field: u64, content: &[u8]) {
        self.varint(field << 3 | 2);
        self.varint(content.len() as u64);
        self.0.extend_from_slice(content);
    }

    fn text(&mut self, field: u64, text: &str) {
        self.bytes(field, text.as_bytes());
    }

    fn message(&mut self, field: u64, message: &Message) {
        self.bytes(field, &message.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_have_the_bytes_of_the_protocol_buffers_documentation() {
        let mut message = Message::default();
        message.integer(1, 150);
        message.text(2, "testing");
        assert_eq!(message.0, [&[0x08, 0x96, 0x01, 0x12, 0x07][..], b"testing"].concat());
    }
}
