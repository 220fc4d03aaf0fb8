//! Small ensembles of actuator networks and an interrupted training, as safetensors files.

use serde_json::{Map, Value, json};
use twinstep_effects::ActuatorNetworkConfig;
use twinstep_ensemble::{
    Ensemble, EnsembleMetadata, JointEncoding, NetworkInput, NetworkTarget, Normaliser, Normalisers,
};
use twinstep_logs::TorqueSensor;
use twinstep_model::JOINT_NAMES;

/// Number of units of the networks.
const HIDDEN: usize = 2;

/// Returns the settings with which the ensemble is loaded.
pub fn settings() -> ActuatorNetworkConfig {
    ActuatorNetworkConfig { ensemble: "ensemble".into(), sample: true, ..ActuatorNetworkConfig::default() }
}

/// Returns an ensemble of two members.
pub fn ensemble() -> Vec<u8> {
    let scale = Normaliser { mean: 0.1, std: 2.5 };
    let ensemble = Ensemble::untrained(EnsembleMetadata {
        members: 2,
        hidden: HIDDEN,
        dt: 0.005,
        joints: JOINT_NAMES.map(str::to_owned).to_vec(),
        joint_input: JointEncoding::Kind,
        input: NetworkInput::default(),
        target: NetworkTarget::default(),
        scales: Normalisers { inputs: [scale, scale], torque: scale },
        tau_sensor: TorqueSensor::JointOutput,
        gains: vec![[20.0, 0.5]; 12],
        variance_scale: 1.25,
        data_hash: "0123456789abcdef".to_owned(),
        seed: 9,
    });
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("ensemble");
    ensemble.write(&path).expect("an ensemble can be written");
    std::fs::read(path).expect("the ensemble was written")
}

/// Returns a training of one member after two epochs.
pub fn training() -> Vec<u8> {
    let epoch = json!({ "training_nll": 1.5, "validation_nll": 1.75 });
    let header = json!({
        "options": { "members": 1, "hidden": HIDDEN, "joint_input": "pooled", "epochs": 10, "seed": 5 },
        "data_hash": "0123456789abcdef", "inputs": 2, "curves": [[epoch, epoch]],
    });
    let mut file = SafeTensors::new("training", &header);
    for role in ["weights", "best"] {
        let shapes: [(&str, &[usize]); 11] = [
            ("lstm.input_weight", &[2, 4 * HIDDEN]),
            ("lstm.hidden_weight", &[HIDDEN, 4 * HIDDEN]),
            ("lstm.bias", &[4 * HIDDEN]),
            ("mean.hidden.weight", &[HIDDEN, HIDDEN]),
            ("mean.hidden.bias", &[HIDDEN]),
            ("mean.weight", &[HIDDEN, 1]),
            ("mean.bias", &[1]),
            ("variance.hidden.weight", &[HIDDEN, HIDDEN]),
            ("variance.hidden.bias", &[HIDDEN]),
            ("variance.weight", &[HIDDEN, 1]),
            ("variance.bias", &[1]),
        ];
        for (name, shape) in shapes {
            let numbers = vec![0.25f32; shape.iter().product()];
            let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
            file.add(&format!("0.{role}.{name}"), "F32", shape, &bytes);
        }
    }
    file.add("0.optimizer", "U8", &[16], &[7; 16]);
    file.bytes()
}

/// A file in the safetensors format: length of the header, header as JSON, arrays.
struct SafeTensors {
    header: Map<String, Value>,
    data: Vec<u8>,
}

impl SafeTensors {
    fn new(key: &str, metadata: &Value) -> Self {
        let metadata = json!({ key: metadata.to_string() });
        Self { header: Map::from_iter([("__metadata__".to_owned(), metadata)]), data: Vec::new() }
    }

    fn add(&mut self, name: &str, kind: &str, shape: &[usize], bytes: &[u8]) {
        let start = self.data.len();
        self.data.extend(bytes);
        let array = json!({ "dtype": kind, "shape": shape, "data_offsets": [start, self.data.len()] });
        self.header.insert(name.to_owned(), array);
    }

    fn bytes(self) -> Vec<u8> {
        with_header(Value::Object(self.header).to_string().as_bytes(), &self.data)
    }
}

/// Returns a safetensors file with this header.
pub fn with_header(header: &[u8], data: &[u8]) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes()[..], header, data].concat()
}

/// Returns header and data of a safetensors file.
pub fn header_and_data(bytes: &[u8]) -> (&[u8], &[u8]) {
    let (length, rest) = bytes.split_at(8);
    let length: [u8; 8] = length.try_into().expect("eight bytes");
    rest.split_at(u64::from_le_bytes(length) as usize)
}
