//! The graph of an ONNX file. Field numbers are those of `onnx.proto`, version 1.17.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use crate::onnx::protobuf::{Value, fields};
use crate::onnx::tensor::Tensor;

/// `TensorProto.DataType`.
pub const FLOAT: i64 = 1;
/// `TensorProto.DataType`.
pub const INT32: i64 = 6;
/// `TensorProto.DataType`.
pub const INT64: i64 = 7;
/// `TensorProto.DataType`.
pub const BOOL: i64 = 9;
/// `TensorProto.DataType`.
pub const DOUBLE: i64 = 11;

/// Content of an ONNX file.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// Operations, each after those whose outputs it reads.
    pub nodes: Vec<Node>,
    /// Weights and other constants.
    pub constants: HashMap<String, Tensor>,
    /// Inputs that are not constants.
    pub inputs: Vec<Input>,
    /// Names of the outputs of the graph.
    pub outputs: Vec<String>,
    /// Metadata of the file.
    pub metadata: BTreeMap<String, String>,
}

/// An operation.
#[derive(Clone, Debug, Default)]
pub struct Node {
    /// Name of the operator.
    pub operator: String,
    /// Names of the inputs; empty for an optional one that is left out.
    pub inputs: Vec<String>,
    /// Names of the outputs.
    pub outputs: Vec<String>,
    /// Attributes.
    pub attributes: HashMap<String, Attribute>,
}

/// Attribute of an operation.
#[derive(Clone, Debug, Default)]
pub struct Attribute {
    /// One float.
    pub float: Option<f32>,
    /// One integer.
    pub integer: Option<i64>,
    /// Floats.
    pub floats: Vec<f32>,
    /// Integers.
    pub integers: Vec<i64>,
    /// A text.
    pub text: Option<String>,
    /// Texts.
    pub texts: Vec<String>,
    /// An array.
    pub tensor: Option<Tensor>,
}

/// An input of the graph.
#[derive(Clone, Debug, Default)]
pub struct Input {
    /// Name.
    pub name: String,
    /// `TensorProto.DataType`; 0 if it is not a tensor.
    pub kind: i64,
    /// Length of each dimension; `None` if it is variable.
    pub shape: Vec<Option<i64>>,
}

/// Reads the bytes of an ONNX file. Weights may be in other files in `folder`.
pub fn read(bytes: &[u8], folder: &Path) -> Result<Graph, String> {
    let mut graph = Graph::default();
    for (number, value) in fields(bytes)? {
        match number {
            7 => read_graph(value.bytes()?, folder, &mut graph)?,
            14 => {
                let (key, text) = read_entry(value.bytes()?)?;
                graph.metadata.insert(key, text);
            }
            _ => {}
        }
    }
    if graph.nodes.is_empty() {
        return Err("it is not an ONNX file, or has no operations".to_owned());
    }
    // Old files list their weights among the inputs.
    let Graph { inputs, constants, .. } = &mut graph;
    inputs.retain(|input| !constants.contains_key(&input.name));
    Ok(graph)
}

fn read_graph(bytes: &[u8], folder: &Path, graph: &mut Graph) -> Result<(), String> {
    for (number, value) in fields(bytes)? {
        match number {
            1 => graph.nodes.push(read_node(value.bytes()?, folder)?),
            5 => {
                let (name, tensor) = read_tensor(value.bytes()?, folder)?;
                graph.constants.insert(name, tensor);
            }
            11 => graph.inputs.push(read_input(value.bytes()?)?),
            12 => graph.outputs.push(read_input(value.bytes()?)?.name),
            _ => {}
        }
    }
    Ok(())
}

fn read_node(bytes: &[u8], folder: &Path) -> Result<Node, String> {
    let mut node = Node::default();
    for (number, value) in fields(bytes)? {
        match number {
            1 => node.inputs.push(value.text()?),
            2 => node.outputs.push(value.text()?),
            4 => node.operator = value.text()?,
            5 => {
                let (name, attribute) = read_attribute(value.bytes()?, folder)?;
                node.attributes.insert(name, attribute);
            }
            _ => {}
        }
    }
    Ok(node)
}

fn read_attribute(bytes: &[u8], folder: &Path) -> Result<(String, Attribute), String> {
    let (mut name, mut attribute) = (String::new(), Attribute::default());
    for (number, value) in fields(bytes)? {
        match (number, value) {
            (1, _) => name = value.text()?,
            (2, Value::Fixed32(bytes)) => attribute.float = Some(f32::from_le_bytes(bytes)),
            (3, _) => attribute.integer = Some(value.integer()?),
            (4, _) => attribute.text = Some(value.text()?),
            (5, _) => attribute.tensor = Some(read_tensor(value.bytes()?, folder)?.1),
            (7, _) => value.floats(&mut attribute.floats)?,
            (9, _) => attribute.texts.push(value.text()?),
            (8, _) => value.integers(&mut attribute.integers)?,
            _ => {}
        }
    }
    Ok((name, attribute))
}

/// Returns name and value of a `TensorProto`.
fn read_tensor(bytes: &[u8], folder: &Path) -> Result<(String, Tensor), String> {
    let (mut name, mut kind, mut dimensions) = (String::new(), 0, Vec::new());
    let (mut floats, mut doubles, mut integers) = (Vec::new(), Vec::new(), Vec::new());
    let (mut raw, mut external) = (Vec::new(), BTreeMap::new());
    for (number, value) in fields(bytes)? {
        match number {
            1 => value.integers(&mut dimensions)?,
            2 => kind = value.integer()?,
            4 => value.floats(&mut floats)?,
            5 | 7 => value.integers(&mut integers)?,
            10 => value.doubles(&mut doubles)?,
            8 => name = value.text()?,
            9 => raw = value.bytes()?.to_vec(),
            13 => external.extend([read_entry(value.bytes()?)?]),
            _ => {}
        }
    }
    if !external.is_empty() {
        raw = read_external(&external, folder)?;
    }
    let shape: Option<Vec<usize>> = dimensions.iter().map(|len| usize::try_from(*len).ok()).collect();
    let shape = shape.ok_or_else(|| format!("`{name}` has the dimensions {dimensions:?}"))?;
    let tensor = match kind {
        FLOAT => {
            floats.extend(raw.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)));
            Tensor::floats(shape, floats)
        }
        DOUBLE => {
            doubles.extend(raw.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)));
            Tensor::floats(shape, doubles.into_iter().map(|number| number as f32).collect())
        }
        INT64 => {
            integers.extend(raw.as_chunks().0.iter().map(|bytes| i64::from_le_bytes(*bytes)));
            Tensor::integers(shape, integers)
        }
        INT32 => {
            integers.extend(raw.as_chunks().0.iter().map(|bytes| i64::from(i32::from_le_bytes(*bytes))));
            // Numbers of 32 bits are written with or without their sign.
            Tensor::integers(shape, integers.into_iter().map(|number| i64::from(number as i32)).collect())
        }
        BOOL => {
            integers.extend(raw.iter().map(|byte| i64::from(*byte)));
            Tensor::integers(shape, integers.into_iter().map(|number| i64::from(number != 0)).collect())
        }
        _ => Err(format!("numbers of type {kind}; floats (1, 11), integers (6, 7) and truth values (9) are supported")),
    };
    tensor.map(|tensor| (name.clone(), tensor)).map_err(|problem| format!("`{name}` has {problem}"))
}

/// Reads weights that are in a file of their own, as PyTorch writes them.
fn read_external(entries: &BTreeMap<String, String>, folder: &Path) -> Result<Vec<u8>, String> {
    let location = entries.get("location").ok_or("its weights are in another file without a name")?;
    let relative = Path::new(location);
    if relative.components().count() != 1 || relative.file_name().is_none() {
        return Err(format!("its weights are in `{location}`, which is not in the same folder"));
    }
    let bytes =
        std::fs::read(folder.join(relative)).map_err(|error| format!("its weights are in `{location}`: {error}"))?;
    let number = |key: &str, default: usize| entries.get(key).map_or(Some(default), |text| text.parse().ok());
    let range = number("offset", 0).and_then(|offset| {
        let len = number("length", bytes.len().saturating_sub(offset))?;
        bytes.get(offset..offset.checked_add(len)?)
    });
    range.map(<[u8]>::to_vec).ok_or_else(|| format!("`{location}` is shorter than the weights"))
}

/// Returns key and value of a `StringStringEntryProto`.
fn read_entry(bytes: &[u8]) -> Result<(String, String), String> {
    let (mut key, mut text) = (String::new(), String::new());
    for (number, value) in fields(bytes)? {
        match number {
            1 => key = value.text()?,
            2 => text = value.text()?,
            _ => {}
        }
    }
    Ok((key, text))
}

/// Reads a `ValueInfoProto`.
fn read_input(bytes: &[u8]) -> Result<Input, String> {
    let mut input = Input::default();
    for (number, value) in fields(bytes)? {
        match number {
            1 => input.name = value.text()?,
            // TypeProto, with the tensor type as field 1.
            2 => {
                for (_, tensor) in fields(value.bytes()?)?.into_iter().filter(|(number, _)| *number == 1) {
                    read_tensor_type(tensor.bytes()?, &mut input)?;
                }
            }
            _ => {}
        }
    }
    Ok(input)
}

fn read_tensor_type(bytes: &[u8], input: &mut Input) -> Result<(), String> {
    for (number, value) in fields(bytes)? {
        match number {
            1 => input.kind = value.integer()?,
            2 => {
                for (_, dimension) in fields(value.bytes()?)? {
                    let len = fields(dimension.bytes()?)?.into_iter().find(|(number, _)| *number == 1);
                    input.shape.push(len.map(|(_, len)| len.integer()).transpose()?);
                }
            }
            _ => {}
        }
    }
    Ok(())
}
