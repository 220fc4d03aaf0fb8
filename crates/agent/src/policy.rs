//! Policies of any source: reading, comparison with the robot, evaluation.

use std::path::{Path, PathBuf};

use twinstep_model::EnvSpec;
use twinstep_policy::{Policy, PolicyRunner};

use crate::error::AgentError;
use crate::mapped_policy::MappedPolicy;
use crate::mapping::Mapping;
use crate::onnx::{OnnxNetwork, Port};
use crate::policy_input::PolicyInput;

/// A policy that was read from a file.
#[derive(Clone, Debug)]
pub struct LoadedPolicy(Source);

#[derive(Clone, Debug)]
enum Source {
    /// Policy file of `twinstep train`.
    File(Box<Policy>),
    /// ONNX file of `twinstep train`, with the spec of its environment.
    Onnx(OnnxNetwork, Box<EnvSpec>),
    /// ONNX file of another program.
    Mapped(OnnxNetwork, Box<Mapping>),
}

/// A policy that fits a robot.
#[derive(Clone, Debug)]
pub struct BoundPolicy(Evaluator);

#[derive(Clone, Debug)]
enum Evaluator {
    File(Box<PolicyRunner>, usize),
    Onnx(OnnxNetwork),
    Mapped(Box<MappedPolicy>),
}

impl LoadedPolicy {
    /// Reads a policy: `*.safetensors` or `*.onnx`. `mapping` is for the ONNX file of another program.
    pub fn read(path: impl AsRef<Path>, mapping: Option<&Path>) -> Result<Self, AgentError> {
        let path = path.as_ref();
        let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
        let unused_mapping = || AgentError::UnusedMapping { path: path.to_owned() };
        match (extension, mapping) {
            ("safetensors", None) => Ok(Self(Source::File(Box::new(Policy::read(path)?.0)))),
            ("safetensors", Some(_)) => Err(unused_mapping()),
            ("onnx", Some(mapping)) => {
                let mapping = Mapping::read(mapping)?;
                Ok(Self(Source::Mapped(OnnxNetwork::read(path)?, Box::new(mapping))))
            }
            ("onnx", None) => {
                let network = OnnxNetwork::read(path)?;
                let spec = own_spec(&network, path)?;
                Ok(Self(Source::Onnx(network, Box::new(spec))))
            }
            _ => Err(AgentError::UnknownFormat { path: path.to_owned() }),
        }
    }

    /// Returns the policy of a network of another program.
    pub fn mapped(network: OnnxNetwork, mapping: Mapping) -> Self {
        Self(Source::Mapped(network, Box::new(mapping)))
    }

    /// Returns the spec that the policy was trained for. `None`: the file of another program has none.
    pub fn spec(&self) -> Option<&EnvSpec> {
        match &self.0 {
            Source::File(policy) => Some(&policy.spec),
            Source::Onnx(_, spec) => Some(spec),
            Source::Mapped(..) => None,
        }
    }

    /// Returns the policy for a robot. Fails with every difference if they do not agree.
    pub fn bind(self, spec: &EnvSpec) -> Result<BoundPolicy, AgentError> {
        match self.0 {
            Source::File(policy) => {
                check_spec(&policy.spec, spec)?;
                Ok(BoundPolicy(Evaluator::File(Box::new(PolicyRunner::new(&policy)), spec.action_len())))
            }
            Source::Onnx(network, own) => {
                check_spec(&own, spec)?;
                let (inputs, outputs) = (network.inputs(), network.outputs());
                for (what, given, expected) in [
                    ("inputs", inputs.iter().map(Port::len).sum(), own.obs_len()),
                    ("outputs", outputs[0].len(), own.action_len()),
                ] {
                    if given != expected {
                        let hint = "the `spec` in its metadata does not belong to it".to_owned();
                        return Err(AgentError::NetworkSize { what, given, expected, hint });
                    }
                }
                Ok(BoundPolicy(Evaluator::Onnx(network)))
            }
            Source::Mapped(network, mapping) => {
                Ok(BoundPolicy(Evaluator::Mapped(Box::new(MappedPolicy::new(network, *mapping, spec)?))))
            }
        }
    }
}

impl BoundPolicy {
    /// Starts a new episode: the policy has no earlier observations.
    pub fn reset(&mut self) {
        if let Evaluator::Mapped(policy) = &mut self.0 {
            policy.reset();
        }
    }

    /// Returns the action in the order and scale of the robot, not clipped.
    pub fn action(&mut self, input: &PolicyInput) -> Result<Vec<f32>, AgentError> {
        match &mut self.0 {
            Evaluator::File(runner, outputs) => {
                let mut action = vec![0.0; *outputs];
                runner.run(input.obs, &mut action);
                Ok(action)
            }
            Evaluator::Onnx(network) => Ok(network.run(&[input.obs])?.swap_remove(0)),
            Evaluator::Mapped(policy) => policy.action(input),
        }
    }
}

/// Returns the spec in the metadata of an ONNX file.
fn own_spec(network: &OnnxNetwork, path: &Path) -> Result<EnvSpec, AgentError> {
    let path: PathBuf = path.to_owned();
    let Some(text) = network.metadata("spec") else { return Err(AgentError::NoMapping { path }) };
    serde_json::from_str(text).map_err(|error| AgentError::Spec { path, reason: error.to_string() })
}

fn check_spec(policy: &EnvSpec, endpoint: &EnvSpec) -> Result<(), AgentError> {
    let differences = policy.differences(endpoint);
    if differences.is_empty() {
        return Ok(());
    }
    let hint = "for other gains, pose, scale or rate start the endpoint with the policy's contract: `--contract POLICY`, for \
                `twinstep serve` and for `twinstep robot`; for another robot or task serve those of its training, or train it on \
                this one (`twinstep train --endpoint ENDPOINT`)";
    Err(AgentError::Disagreement { differences, hint: hint.to_owned() })
}
