//! ONNX files with one observation as input and an action as first output.
//!
//! Networks of policies consist of few operators on small arrays, so a plain evaluation of the graph takes less than a
//! millisecond. A library that evaluates any network, tract 0.23, took 16 minutes of processor time to compile.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

mod graph;
mod operators;
mod protobuf;
mod tensor;

use graph::{FLOAT, Graph, Input, Node};
use tensor::Tensor;

/// Largest length of an observation.
const MAX_INPUTS: i64 = 1 << 20;
/// Maximum number of entries of all arrays that an evaluation computes.
const MAX_ENTRIES: usize = 1 << 26;

/// Network of an ONNX file. The first output is the action; others are ignored.
#[derive(Clone, Debug)]
pub struct OnnxNetwork {
    path: PathBuf,
    nodes: Vec<Node>,
    constants: HashMap<String, Tensor>,
    input: String,
    output: String,
    inputs: usize,
    outputs: usize,
    metadata: BTreeMap<String, String>,
}

/// Reasons why an ONNX file cannot be read or evaluated.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// The file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// The content is not that of an ONNX file.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The file has other inputs than one observation.
    #[error(
        "{} has the inputs {found}; one observation of 32-bit floats, [1, n] or [batch, n], is expected\n  recurrent policies \
         with a state among their inputs are not supported",
        path.display()
    )]
    Inputs {
        /// The file.
        path: PathBuf,
        /// Name, type and shape of every input.
        found: String,
    },
    /// The first output is not one action.
    #[error("{} has a first output with the dimensions {found:?}; one action, [1, n], is expected", path.display())]
    Output {
        /// The file.
        path: PathBuf,
        /// Dimensions of the first output.
        found: Vec<usize>,
    },
    /// An operation cannot be evaluated.
    #[error("{}: operator {operator} {problem}", path.display())]
    Operation {
        /// The file.
        path: PathBuf,
        /// Name of the operator.
        operator: String,
        /// What is wrong.
        problem: String,
    },
}

impl OnnxNetwork {
    /// Reads an ONNX file, and evaluates it once.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, OnnxError> {
        let path = path.as_ref().to_owned();
        let bytes = std::fs::read(&path).map_err(|cause| OnnxError::File { path: path.clone(), cause })?;
        let content = |problem| OnnxError::Content { path: path.clone(), problem };
        let graph = graph::read(&bytes, path.parent().unwrap_or(Path::new(""))).map_err(content)?;
        let (input, inputs) = observation(&graph).map_err(|found| OnnxError::Inputs { path: path.clone(), found })?;
        let output = graph.outputs.first().cloned().ok_or_else(|| content("it has no output".to_owned()))?;
        let Graph { nodes, constants, metadata, .. } = graph;
        let mut network = Self { path, nodes, constants, input, output, inputs, outputs: 0, metadata };
        let action = network.evaluate(&vec![0.0; inputs])?;
        match action.shape[..] {
            [1, outputs] if outputs > 0 && action.as_floats().is_ok() => network.outputs = outputs,
            _ => return Err(OnnxError::Output { path: network.path, found: action.shape }),
        }
        Ok(network)
    }

    /// Returns the length of the observation.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Returns the length of the action.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Returns an entry of the file's metadata.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    /// Returns the first output for an observation of [`OnnxNetwork::inputs`] numbers.
    pub fn run(&self, obs: &[f32]) -> Result<Vec<f32>, OnnxError> {
        let action = self.evaluate(obs)?;
        let problem = |problem| OnnxError::Content { path: self.path.clone(), problem };
        action.as_floats().map(<[f32]>::to_vec).map_err(problem)
    }

    /// Returns the index of the last operation that reads each value.
    fn last_uses(&self) -> HashMap<&str, usize> {
        let uses = self.nodes.iter().enumerate();
        uses.flat_map(|(index, node)| node.inputs.iter().map(move |name| (name.as_str(), index))).collect()
    }

    fn evaluate(&self, obs: &[f32]) -> Result<Tensor, OnnxError> {
        let content = |problem| OnnxError::Content { path: self.path.clone(), problem };
        let obs = Tensor::floats(vec![1, self.inputs], obs.to_vec()).map_err(content)?;
        let mut values: HashMap<&str, Tensor> = HashMap::from([(self.input.as_str(), obs)]);
        let last_uses = self.last_uses();
        let mut entries = 0;
        for (index, node) in self.nodes.iter().enumerate() {
            let operation =
                |problem| OnnxError::Operation { path: self.path.clone(), operator: node.operator.clone(), problem };
            let value = |name: &String| {
                let found = values.get(name.as_str()).or_else(|| self.constants.get(name));
                found.ok_or_else(|| operation(format!("reads `{name}`, which does not exist before it")))
            };
            let inputs = node.inputs.iter().map(|name| if name.is_empty() { Ok(None) } else { value(name).map(Some) });
            let inputs = inputs.collect::<Result<Vec<_>, _>>()?;
            let result = operators::evaluate(node, &inputs).map_err(operation)?;
            entries += result.shape.iter().product::<usize>();
            if entries > MAX_ENTRIES {
                return Err(operation(format!("makes the arrays of one evaluation longer than {MAX_ENTRIES} numbers")));
            }
            if let Some(name) = node.outputs.first() {
                values.insert(name, result);
            }
            values.retain(|name, _| last_uses.get(name).is_some_and(|last| *last > index) || *name == self.output);
        }
        values
            .remove(self.output.as_str())
            .ok_or_else(|| content(format!("no operation computes its output `{}`", self.output)))
    }
}

/// Returns name and length of the only input. Returns a description of all inputs if there is not one observation.
fn observation(graph: &Graph) -> Result<(String, usize), String> {
    let described = || graph.inputs.iter().map(description).collect::<Vec<_>>().join(", ");
    let [input] = &graph.inputs[..] else {
        return Err(if graph.inputs.is_empty() { "none".to_owned() } else { described() });
    };
    match input.shape[..] {
        [Some(1) | None, Some(len)] if input.kind == FLOAT && (1..=MAX_INPUTS).contains(&len) => {
            Ok((input.name.clone(), len as usize))
        }
        _ => Err(described()),
    }
}

fn description(input: &Input) -> String {
    let kind = if input.kind == FLOAT { "float".to_owned() } else { format!("type {}", input.kind) };
    let shape: Vec<String> =
        input.shape.iter().map(|len| len.map_or_else(|| "?".to_owned(), |len| len.to_string())).collect();
    format!("`{}` ({kind} [{}])", input.name, shape.join(", "))
}
