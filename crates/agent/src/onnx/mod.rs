//! ONNX files of policies: any number of inputs and outputs of floats.
//!
//! - [`OnnxNetwork`]: the evaluator. Its [`Port`]s are the inputs and outputs.
//! - [`graph`]: what the file says. [`operators`]: what an operation computes, in plain loops over [`Tensor`]s.
//!
//! Networks of policies are small, so that plain loops take microseconds. The library rten 0.27 was tried in their place: it
//! is as fast, but adds two minutes of processor time to the build and 6 MB to the program, has no bound of memory, and does
//! not come back from a file of which a byte was changed. tract 0.23 took 16 minutes of processor time to compile.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

mod graph;
mod operators;
mod protobuf;
mod tensor;
#[cfg(test)]
mod tests;

use graph::{FLOAT, Graph, Input, Node};
use tensor::{Tensor, len};

/// Most entries of an input.
const MAX_INPUT: usize = 1 << 20;
/// Maximum number of entries of all arrays that an evaluation computes.
const MAX_ENTRIES: usize = 1 << 24;

/// Network of an ONNX file.
#[derive(Clone, Debug)]
pub struct OnnxNetwork {
    path: PathBuf,
    operations: Vec<Operation>,
    /// Constants in their places; `None` for values that an evaluation computes.
    constants: Vec<Option<Tensor>>,
    inputs: Vec<Port>,
    outputs: Vec<Port>,
    metadata: BTreeMap<String, String>,
}

/// An input or output of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Name in the file.
    pub name: String,
    /// Length of each dimension; that of a batch, which the file leaves open, is 1.
    pub shape: Vec<usize>,
    /// Place of its value.
    place: usize,
}

impl Port {
    /// Returns the number of entries.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns true if the port has no entries.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// An operation with the places of its values.
#[derive(Clone, Debug)]
struct Operation {
    node: Node,
    inputs: Vec<Option<usize>>,
    outputs: Vec<Option<usize>>,
    /// Places whose last use is this operation.
    last_uses: Vec<usize>,
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
    /// An input is not an array of floats.
    #[error(
        "{} has the inputs {found}; arrays of 32-bit floats with a batch of 1 are expected\n  an observation is [1, n] or \
         [batch, n], the state of a recurrent network [layers, 1, n]",
        path.display()
    )]
    Inputs {
        /// The file.
        path: PathBuf,
        /// Name, type and shape of every input.
        found: String,
    },
    /// An operation cannot be evaluated.
    #[error("{}: operator {operator}, which makes `{output}`, {problem}", path.display())]
    Operation {
        /// The file.
        path: PathBuf,
        /// Name of the operator.
        operator: String,
        /// Name of its first output.
        output: String,
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
        let mut network = Self::compile(graph, path)?;
        let zeros: Vec<Vec<f32>> = network.inputs.iter().map(|input| vec![0.0; input.len()]).collect();
        let outputs = network.evaluate(&zeros.iter().map(Vec::as_slice).collect::<Vec<_>>())?;
        for (port, output) in network.outputs.iter_mut().zip(&outputs) {
            port.shape.clone_from(&output.shape);
        }
        Ok(network)
    }

    /// Gives each value a place, and evaluates what depends on constants alone.
    fn compile(graph: Graph, path: PathBuf) -> Result<Self, OnnxError> {
        let inputs = ports(&graph).map_err(|found| OnnxError::Inputs { path: path.clone(), found })?;
        let Graph { nodes, constants: weights, outputs, metadata, .. } = graph;
        let mut places: HashMap<String, usize> = HashMap::new();
        let mut constants: Vec<Option<Tensor>> = Vec::new();
        let mut inputs: Vec<Port> = inputs;
        for input in &mut inputs {
            input.place = constants.len();
            places.insert(input.name.clone(), input.place);
            constants.push(None);
        }
        for (name, tensor) in weights {
            places.insert(name, constants.len());
            constants.push(Some(tensor));
        }
        let (mut operations, mut entries) = (Vec::new(), 0);
        for node in nodes {
            let failed = |problem| failure(&path, &node, problem);
            let place = |name: &String| {
                let found = places.get(name).copied();
                let problem = || failed(format!("reads `{name}`, which does not exist before it"));
                if name.is_empty() { Ok(None) } else { found.map(Some).ok_or_else(problem) }
            };
            let read = node.inputs.iter().map(place).collect::<Result<Vec<_>, _>>()?;
            let is_constant = read.iter().flatten().all(|place| constants[*place].is_some());
            let results = if is_constant {
                let values: Vec<_> =
                    read.iter().map(|place| place.and_then(|place| constants[place].as_ref())).collect();
                let results = operators::evaluate(&node, &values).map_err(failed)?;
                count(&results, &mut entries).map_err(failed)?;
                Some(results)
            } else {
                None
            };
            let first = constants.len();
            let written: Vec<Option<usize>> = (0..node.outputs.len())
                .map(|index| (!node.outputs[index].is_empty()).then_some(first + index))
                .collect();
            for (index, name) in node.outputs.iter().enumerate() {
                constants.push(results.as_ref().and_then(|results| results.get(index).cloned()));
                places.insert(name.clone(), first + index);
            }
            if results.is_none() {
                operations.push(Operation { node, inputs: read, outputs: written, last_uses: Vec::new() });
            }
        }
        let port = |name: &String| {
            let place = places.get(name).copied();
            place.map(|place| Port { name: name.clone(), shape: Vec::new(), place }).ok_or_else(|| OnnxError::Content {
                path: path.clone(),
                problem: format!("no operation computes its output `{name}`"),
            })
        };
        let outputs = outputs.iter().map(port).collect::<Result<Vec<_>, _>>()?;
        if outputs.is_empty() {
            return Err(OnnxError::Content { path, problem: "it has no output".to_owned() });
        }
        mark_last_uses(&mut operations, &outputs, constants.len());
        Ok(Self { path, operations, constants, inputs, outputs, metadata })
    }

    /// Returns the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the inputs.
    pub fn inputs(&self) -> &[Port] {
        &self.inputs
    }

    /// Returns the outputs; the first one is the action, [1, n].
    pub fn outputs(&self) -> &[Port] {
        &self.outputs
    }

    /// Returns an entry of the file's metadata.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    /// Returns all outputs for the values of all inputs, each with [`Port::len`] numbers.
    pub fn run(&self, inputs: &[&[f32]]) -> Result<Vec<Vec<f32>>, OnnxError> {
        Ok(self.evaluate(inputs)?.iter().map(Tensor::to_floats).collect())
    }

    fn evaluate(&self, inputs: &[&[f32]]) -> Result<Vec<Tensor>, OnnxError> {
        let content = |problem| OnnxError::Content { path: self.path.clone(), problem };
        let mut values: Vec<Option<Tensor>> = vec![None; self.constants.len()];
        if inputs.len() != self.inputs.len() {
            return Err(content(format!("{} inputs were given; it has {}", inputs.len(), self.inputs.len())));
        }
        for (port, input) in self.inputs.iter().zip(inputs) {
            values[port.place] = Some(Tensor::floats(port.shape.clone(), input.to_vec()).map_err(content)?);
        }
        let mut entries = 0;
        for Operation { node, inputs, outputs, last_uses } in &self.operations {
            let failed = |problem| failure(&self.path, node, problem);
            let value = |place: usize| values[place].as_ref().or(self.constants[place].as_ref());
            let read: Vec<_> = inputs.iter().map(|place| place.and_then(value)).collect();
            let results = operators::evaluate(node, &read).map_err(failed)?;
            count(&results, &mut entries).map_err(failed)?;
            for (place, result) in outputs.iter().zip(results) {
                if let Some(place) = place {
                    values[*place] = Some(result);
                }
            }
            for place in last_uses {
                values[*place] = None;
            }
        }
        let output = |port: &Port| {
            let value = values[port.place].clone().or_else(|| self.constants[port.place].clone());
            value.ok_or_else(|| content(format!("no operation computes its output `{}`", port.name)))
        };
        self.outputs.iter().map(output).collect()
    }
}

fn failure(path: &Path, node: &Node, problem: String) -> OnnxError {
    OnnxError::Operation {
        path: path.to_owned(),
        operator: node.operator.clone(),
        output: node.outputs.first().cloned().unwrap_or_default(),
        problem,
    }
}

/// Adds the entries of arrays to those of an evaluation. Fails if they are too many.
fn count(results: &[Tensor], entries: &mut usize) -> Result<(), String> {
    *entries += results.iter().map(Tensor::len).sum::<usize>();
    if *entries > MAX_ENTRIES {
        return Err(format!("makes the arrays of one evaluation longer than {MAX_ENTRIES} numbers"));
    }
    Ok(())
}

fn mark_last_uses(operations: &mut [Operation], outputs: &[Port], places: usize) {
    let mut is_needed = vec![false; places];
    for port in outputs {
        is_needed[port.place] = true;
    }
    for operation in operations.iter_mut().rev() {
        for place in operation.inputs.iter().chain(&operation.outputs).flatten() {
            if !std::mem::replace(&mut is_needed[*place], true) {
                operation.last_uses.push(*place);
            }
        }
    }
}

/// Returns the inputs. Returns a description of all of them if one is no array of floats.
fn ports(graph: &Graph) -> Result<Vec<Port>, String> {
    let described = || graph.inputs.iter().map(description).collect::<Vec<_>>().join(", ");
    let port = |input: &Input| {
        let lengths: Option<Vec<usize>> =
            input.shape.iter().map(|len| usize::try_from(len.unwrap_or(1)).ok().filter(|len| *len > 0)).collect();
        let shape = lengths.filter(|shape| len(shape).is_ok_and(|len| len <= MAX_INPUT))?;
        // The length of an observation is known; only its batch may be open.
        let is_known = input.shape.last().is_some_and(Option::is_some);
        (input.kind == FLOAT && is_known).then(|| Port { name: input.name.clone(), shape, place: 0 })
    };
    let ports: Option<Vec<Port>> = graph.inputs.iter().map(port).collect();
    ports
        .filter(|ports| !ports.is_empty())
        .ok_or_else(|| if graph.inputs.is_empty() { "none".to_owned() } else { described() })
}

fn description(input: &Input) -> String {
    let kind = if input.kind == FLOAT { "float".to_owned() } else { format!("type {}", input.kind) };
    let shape: Vec<String> =
        input.shape.iter().map(|len| len.map_or_else(|| "?".to_owned(), |len| len.to_string())).collect();
    format!("`{}` ({kind} [{}])", input.name, shape.join(", "))
}
