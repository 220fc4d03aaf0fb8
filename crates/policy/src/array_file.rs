//! Files in the safetensors format: named arrays of 32-bit floats, and a header as JSON in the metadata.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// An array with its dimensions, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Length of each dimension.
    pub dimensions: Vec<usize>,
    /// Entries.
    pub values: Vec<f32>,
}

/// Arrays by name.
pub type Arrays = BTreeMap<String, Array>;

/// Reasons why a file cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ArrayFileError {
    /// The operating system reported an error.
    #[error("cannot {verb} {}: {cause}", path.display())]
    File {
        /// What was tried.
        verb: &'static str,
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// The content is not that of such a file.
    #[error("{} {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong; continues a sentence that begins with the path.
        problem: String,
    },
}

/// Writes arrays, and `header` under the metadata key `key`. The write is atomic.
pub fn write(path: &Path, key: &str, header: &impl Serialize, arrays: &Arrays) -> Result<(), ArrayFileError> {
    let bytes: Vec<_> = arrays
        .iter()
        .map(|(name, array)| {
            let content: Vec<u8> = array.values.iter().flat_map(|value| value.to_le_bytes()).collect();
            (name, &array.dimensions, content)
        })
        .collect();
    let views = bytes.iter().map(|(name, dimensions, content)| {
        let view = TensorView::new(Dtype::F32, (*dimensions).clone(), content);
        (*name, view.expect("the length of an array is the product of its dimensions"))
    });
    let header = serde_json::to_string(header).expect("a header is plain data");
    // Only one key: the order of several would be random, and equal arrays would have different files.
    let content = serialize(views, Some(HashMap::from([(key.to_owned(), header)]))).expect("the names are unique");
    write_atomically(path, &content)
}

/// Writes a file as a whole.
pub fn write_atomically(path: &Path, content: &[u8]) -> Result<(), ArrayFileError> {
    twinstep_files::write(path, content).map_err(|cause| ArrayFileError::File {
        verb: "write",
        path: path.to_owned(),
        cause,
    })
}

/// Reads all arrays, and the header under the metadata key `key`. All numbers are finite.
pub fn read<T: DeserializeOwned>(path: &Path, key: &str) -> Result<(T, Arrays), ArrayFileError> {
    let content =
        std::fs::read(path).map_err(|cause| ArrayFileError::File { verb: "read", path: path.to_owned(), cause })?;
    let problem = |problem: String| ArrayFileError::Content { path: path.to_owned(), problem };
    let broken = |cause| problem(format!("is not a safetensors file: {cause}"));
    let (_, metadata) = SafeTensors::read_metadata(&content).map_err(broken)?;
    let metadata = metadata.metadata().clone().unwrap_or_default();
    let text = metadata.get(key).ok_or_else(|| problem(format!("has no key `{key}` in its metadata")))?;
    let header = serde_json::from_str(text).map_err(|cause| problem(format!("has an invalid `{key}`: {cause}")))?;
    let tensors = SafeTensors::deserialize(&content).map_err(broken)?;
    let mut arrays = Arrays::new();
    for (name, tensor) in tensors.tensors() {
        if tensor.dtype() != Dtype::F32 {
            return Err(problem(format!("has `{name}` as {:?} instead of F32", tensor.dtype())));
        }
        let (numbers, _) = tensor.data().as_chunks::<4>();
        let values: Vec<f32> = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        if values.iter().any(|value| !value.is_finite()) {
            return Err(problem(format!("has a number in `{name}` that is not finite")));
        }
        arrays.insert(name, Array { dimensions: tensor.shape().to_vec(), values });
    }
    Ok((header, arrays))
}

/// Removes an array from `arrays` and returns its values, if it has `dimensions`.
pub fn take(arrays: &mut Arrays, name: &str, dimensions: &[usize], path: &Path) -> Result<Vec<f32>, ArrayFileError> {
    let problem = |problem: String| Err(ArrayFileError::Content { path: path.to_owned(), problem });
    match arrays.remove(name) {
        Some(array) if array.dimensions == dimensions => Ok(array.values),
        Some(array) => {
            problem(format!("has `{name}` with dimensions {:?} instead of {dimensions:?}", array.dimensions))
        }
        None => problem(format!("has no array `{name}`")),
    }
}
