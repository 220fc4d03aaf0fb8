//! Files in the safetensors format: named arrays, and a header as JSON in the metadata.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::EnsembleError;
use crate::ensemble::Ensemble;
use crate::metadata::EnsembleMetadata;
use crate::network_input::NetworkInput;
use crate::weights::{Shape, Weights};

/// An array of a file.
pub struct Bytes {
    kind: Dtype,
    dimensions: Vec<usize>,
    content: Vec<u8>,
}

impl Bytes {
    /// Creates an array of 32-bit floats, row-major.
    pub fn floats(dimensions: Vec<usize>, numbers: &[f32]) -> Self {
        let content = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        Self { kind: Dtype::F32, dimensions, content }
    }

    /// Creates an array of bytes.
    pub fn plain(content: Vec<u8>) -> Self {
        Self { kind: Dtype::U8, dimensions: vec![content.len()], content }
    }
}

/// Writes arrays, and a header under the metadata key `key`. The write is atomic.
pub fn write(
    path: &Path,
    key: &str,
    header: &impl Serialize,
    arrays: Vec<(String, Bytes)>,
) -> Result<(), EnsembleError> {
    let views = arrays.iter().map(|(name, array)| {
        let view = TensorView::new(array.kind, array.dimensions.clone(), &array.content);
        (name, view.expect("the length of an array is the product of its dimensions"))
    });
    let header = serde_json::to_string(header).expect("a header is plain data");
    // Only one key: the order of several would be random, and equal ensembles would have different files.
    let metadata = HashMap::from([(key.to_owned(), header)]);
    let content = serialize(views, Some(metadata)).expect("the names are unique");
    twinstep_files::write(path, content).map_err(|cause| EnsembleError::File {
        verb: "write",
        path: path.to_owned(),
        cause,
    })
}

/// The content of a file.
pub struct Arrays {
    path: PathBuf,
    content: Vec<u8>,
}

impl Arrays {
    /// Reads the file.
    pub fn read(path: &Path) -> Result<Self, EnsembleError> {
        let content =
            std::fs::read(path).map_err(|cause| EnsembleError::File { verb: "read", path: path.to_owned(), cause })?;
        let arrays = Self { path: path.to_owned(), content };
        arrays.tensors()?;
        Ok(arrays)
    }

    /// Returns the header under the metadata key `key`.
    pub fn header<T: DeserializeOwned>(&self, key: &str) -> Result<T, EnsembleError> {
        let (_, metadata) = SafeTensors::read_metadata(&self.content).map_err(|cause| self.broken(&cause))?;
        let metadata = metadata.metadata().clone().unwrap_or_default();
        let text = metadata.get(key).ok_or_else(|| self.problem(format!("has no key `{key}` in its metadata")))?;
        serde_json::from_str(text).map_err(|cause| self.problem(format!("has an invalid `{key}`: {cause}")))
    }

    /// Returns the weights whose names begin with `prefix`.
    pub fn weights(&self, shape: Shape, prefix: &str) -> Result<Weights, EnsembleError> {
        shape
            .layout()
            .into_iter()
            .map(|(name, expected)| {
                let full = format!("{prefix}.{name}");
                let tensors = self.tensors()?;
                let found = tensors.tensor(&full).map_err(|_| self.problem(format!("has no array `{full}`")))?;
                if found.dtype() != Dtype::F32 || found.shape() != expected {
                    let (kind, dimensions) = (found.dtype(), found.shape());
                    return Err(
                        self.problem(format!("has `{full}` as {kind:?} {dimensions:?} instead of F32 {expected:?}"))
                    );
                }
                let number = |bytes: &[u8]| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                let numbers: Vec<f32> = found.data().chunks_exact(4).map(number).collect();
                if numbers.iter().any(|number| !number.is_finite()) {
                    return Err(self.problem(format!("has a number in `{full}` that is not finite")));
                }
                Ok((name, numbers))
            })
            .collect()
    }

    /// Returns an array of bytes.
    pub fn bytes(&self, name: &str) -> Result<Vec<u8>, EnsembleError> {
        let tensors = self.tensors()?;
        let found = tensors.tensor(name).map_err(|_| self.problem(format!("has no array `{name}`")))?;
        Ok(found.data().to_vec())
    }

    /// Creates an error. `problem` continues a sentence that begins with the path.
    pub fn problem(&self, problem: String) -> EnsembleError {
        EnsembleError::Content { path: self.path.clone(), problem }
    }

    fn tensors(&self) -> Result<SafeTensors<'_>, EnsembleError> {
        SafeTensors::deserialize(&self.content).map_err(|cause| self.broken(&cause))
    }

    fn broken(&self, cause: &impl std::fmt::Display) -> EnsembleError {
        self.problem(format!("is not a safetensors file: {cause}"))
    }
}

impl Ensemble {
    /// Writes a safetensors file.
    ///
    /// It contains the arrays `<member>.<name>` of 32-bit floats, and the [`EnsembleMetadata`] as JSON under the
    /// metadata key `ensemble`.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), EnsembleError> {
        let shape = self.description.shape();
        let arrays = self.members.iter().enumerate().flat_map(|(index, weights)| {
            let array =
                move |(name, dimensions)| (format!("{index}.{name}"), Bytes::floats(dimensions, &weights[name]));
            shape.layout().into_iter().map(array)
        });
        write(path.as_ref(), "ensemble", &self.description, arrays.collect())
    }

    /// Reads a file of [`Ensemble::write`]. Errors name the array that is missing or has the wrong shape.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, EnsembleError> {
        let arrays = Arrays::read(path.as_ref())?;
        let description: EnsembleMetadata = arrays.header("ensemble")?;
        let EnsembleMetadata { members, hidden, .. } = description;
        if members == 0 || hidden == 0 {
            return Err(arrays.problem(format!("has {members} members of {hidden} units; both must be 1 or more")));
        }
        if let Some(problem) = bad_gains(&description) {
            return Err(arrays.problem(problem));
        }
        description.check()?;
        let shape = description.shape();
        let members = (0..description.members).map(|index| arrays.weights(shape, &index.to_string()));
        Ok(Self { members: members.collect::<Result<_, _>>()?, description })
    }
}

/// Returns what is wrong with the gains, or `None` if they are valid.
fn bad_gains(EnsembleMetadata { joints, gains, input, .. }: &EnsembleMetadata) -> Option<String> {
    if *input == NetworkInput::Torque && !joints.is_empty() {
        let given = gains.len();
        return (given > 0)
            .then(|| format!("has `gains` of {given} joints; none are expected with `input` = \"torque\""));
    }
    if joints.is_empty() || joints.len() != gains.len() {
        return Some(format!(
            "has `gains` of {} joints, but {} joints; one pair per joint is expected",
            gains.len(),
            joints.len()
        ));
    }
    let bad =
        gains.iter().zip(joints).find(|(pair, _)| pair.iter().any(|gain| !(0.0..=f64::from(f32::MAX)).contains(gain)));
    bad.map(|([kp, kd], joint)| format!("has `gains` of {joint} with kp {kp} and kd {kd}; both must be 0 or more"))
}

#[cfg(test)]
mod tests {
    use twinstep_logs::TorqueSensor;
    use twinstep_model::stream;

    use super::*;
    use crate::metadata::JointEncoding;
    use crate::normaliser::{Normaliser, Normalisers};

    fn ensemble() -> Ensemble {
        let scale = Normaliser { mean: 0.1, std: 2.5 };
        let description = EnsembleMetadata {
            members: 2,
            hidden: 3,
            dt: 0.005,
            joints: vec!["FL_hip".to_owned(), "FL_calf".to_owned()],
            joint_input: JointEncoding::Kind,
            input: NetworkInput::default(),
            target: crate::NetworkTarget::default(),
            scales: Normalisers { inputs: [scale, scale], torque: scale },
            tau_sensor: TorqueSensor::JointOutput,
            gains: vec![[20.0, 0.5], [25.0, 0.6]],
            variance_scale: 1.25,
            data_hash: "0123456789abcdef".to_owned(),
            seed: 9,
        };
        let members = (0..2).map(|member| description.shape().random(&mut stream(9, "weights", member))).collect();
        Ensemble { description, members }
    }

    /// Returns the error of reading a file after `change` to its arrays.
    fn read_error(change: impl Fn(&mut Vec<(String, Bytes)>)) -> String {
        let (ensemble, folder) = (ensemble(), tempfile::tempdir().expect("a folder"));
        let path = folder.path().join("ensemble.safetensors");
        let mut arrays = Vec::new();
        for (index, weights) in ensemble.members.iter().enumerate() {
            let array = |(name, dimensions)| (format!("{index}.{name}"), Bytes::floats(dimensions, &weights[name]));
            arrays.extend(ensemble.description.shape().layout().into_iter().map(array));
        }
        change(&mut arrays);
        write(&path, "ensemble", &ensemble.description, arrays).expect("written");
        Ensemble::read(&path).expect_err("error").to_string()
    }

    #[test]
    fn reading_inverts_writing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ensemble.safetensors");
        ensemble().write(&path).expect("written");
        let read = Ensemble::read(&path).expect("read");
        assert_eq!(read, ensemble());
        assert!(read.check_step("the simulation", 0.005).is_ok());
        let error = read.check_step("the simulation", 0.001).expect_err("rejected").to_string();
        assert!(error.starts_with("the simulation has a time step of 0.001 s, the model one of 0.005 s"), "{error}");
    }

    #[test]
    fn errors_name_the_array_that_is_missing_or_has_the_wrong_shape() {
        let missing = read_error(|arrays| arrays.retain(|(name, _)| name != "1.mean.bias"));
        assert!(missing.ends_with("has no array `1.mean.bias`"), "{missing}");
        let other = read_error(|arrays| arrays[1].1 = Bytes::floats(vec![12, 3], &[0.0; 36]));
        assert!(other.contains("`0.lstm.hidden_weight` as F32 [12, 3] instead of F32 [3, 12]"), "{other}");
        let nan = read_error(|arrays| arrays[6].1 = Bytes::floats(vec![1], &[f32::NAN]));
        assert!(nan.contains("`0.mean.bias` that is not finite"), "{nan}");
    }

    #[test]
    fn invalid_gains_are_rejected() {
        let error = |gains: &[[f64; 2]]| {
            let (folder, mut ensemble) = (tempfile::tempdir().expect("a folder"), ensemble());
            let path = folder.path().join("ensemble.safetensors");
            ensemble.description.gains = gains.to_vec();
            ensemble.write(&path).expect("written");
            Ensemble::read(&path).expect_err("error").to_string()
        };
        let missing = error(&[[20.0, 0.5]]);
        assert!(
            missing.ends_with("has `gains` of 1 joints, but 2 joints; one pair per joint is expected"),
            "{missing}"
        );
        let negative = error(&[[20.0, 0.5], [20.0, -0.5]]);
        assert!(negative.ends_with("of FL_calf with kp 20 and kd -0.5; both must be 0 or more"), "{negative}");
    }

    #[test]
    fn ensemble_without_members_is_rejected() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ensemble.safetensors");
        let mut ensemble = ensemble();
        (ensemble.description.members, ensemble.members) = (0, Vec::new());
        ensemble.write(&path).expect("written");
        let error = Ensemble::read(&path).expect_err("error").to_string();
        assert!(error.ends_with("has 0 members of 3 units; both must be 1 or more"), "{error}");
    }

    #[test]
    fn other_files_are_rejected_with_their_path() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("other");
        let error = || Ensemble::read(&path).expect_err("error").to_string();
        assert!(error().starts_with("cannot read `"));
        std::fs::write(&path, "not at all").expect("written");
        assert!(error().contains("is not a safetensors file"));
        write(&path, "training", &1, Vec::new()).expect("written");
        assert!(error().ends_with("has no key `ensemble` in its metadata"));
    }
}
