//! Errors of an agent.

use std::path::PathBuf;

use twinstep_logs::LogError;
use twinstep_model::{EnvError, SpecDifference};
use twinstep_policy::array_file::ArrayFileError;

use crate::onnx::OnnxError;

/// Reasons why a policy cannot run.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// A real robot was stopped while it ran the policy.
    #[error("the robot was stopped: {reason}\n  start again, or use `--go-on` to wait for the operator and continue")]
    RobotStopped {
        /// Its fault.
        reason: String,
    },
    /// The extension of the policy is unknown.
    #[error("`{}` is neither *.safetensors nor *.onnx{}", path.display(), torch_hint(path))]
    UnknownFormat {
        /// The policy.
        path: PathBuf,
    },
    /// The policy file cannot be read.
    #[error(transparent)]
    PolicyFile(#[from] ArrayFileError),
    /// The ONNX file cannot be read or evaluated.
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    /// An ONNX file of another program was given without a mapping.
    #[error(
        "{} has no `spec` in its metadata, as the files of `twinstep train` have\n  say with --mapping FILE how its observation \
         and action are made (docs/run.md)",
        path.display()
    )]
    NoMapping {
        /// The policy.
        path: PathBuf,
    },
    /// A mapping was given for a policy of `twinstep train`.
    #[error("{} has its own spec; a mapping is for policies of other programs\n  leave --mapping out", path.display())]
    UnusedMapping {
        /// The policy.
        path: PathBuf,
    },
    /// The `spec` in the metadata of an ONNX file is invalid.
    #[error("{} has an invalid `spec` in its metadata: {reason}", path.display())]
    Spec {
        /// The policy.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// The mapping cannot be read.
    #[error("mapping {}: {reason}", path.display())]
    Mapping {
        /// The mapping.
        path: PathBuf,
        /// What is wrong, where, and what is allowed.
        reason: String,
    },
    /// A config of another program cannot be read.
    #[error("{}: {reason}", path.display())]
    Import {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The contract of a policy cannot be read.
    #[error("contract {}: {reason}", path.display())]
    Contract {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Policy and endpoint do not agree. No action was sent.
    #[error("policy and endpoint do not agree; no action was sent\n{}\n  {hint}", lines(differences))]
    Disagreement {
        /// Every difference; the first value is that of the policy.
        differences: Vec<SpecDifference>,
        /// How to make them agree.
        hint: String,
    },
    /// The endpoint does not have a part of the observation.
    #[error(
        "the policy observes `{term}`, which this endpoint does not give\n  its observations are {available}\n  {hint}"
    )]
    MissingObservation {
        /// Name of the term.
        term: String,
        /// What the endpoint gives.
        available: String,
        /// What to do.
        hint: &'static str,
    },
    /// The network has another number of inputs or outputs than expected.
    #[error("the network has {given} {what}; {expected} are expected\n  {hint}")]
    NetworkSize {
        /// `inputs` or `outputs`.
        what: &'static str,
        /// Number in the network.
        given: usize,
        /// Expected number.
        expected: usize,
        /// How the expected number is made up.
        hint: String,
    },
    /// The mapping names an input or output that the network does not have.
    #[error("the network has no `{name}`; its {what} are {available}")]
    UnknownPort {
        /// The name in the mapping.
        name: String,
        /// `inputs` or `outputs`.
        what: &'static str,
        /// What the network has, with shapes.
        available: String,
    },
    /// It is not known what an input of the network is.
    #[error(
        "the mapping does not say what the network's input {input} is\n  an observation or history: add the table          [input.{name}] to the mapping (docs/run.md); a state: add [[state]] with `input` and `output`\n  no output of its \
         shape follows it; the outputs are {outputs}"
    )]
    UnassignedInput {
        /// The input, with its shape.
        input: String,
        /// Its name.
        name: String,
        /// Outputs of the network, with shapes.
        outputs: String,
    },
    /// The policy computed NaN or an infinite number. It was not sent.
    #[error("the policy's action for {joint} is {value} after {steps} steps; it was not sent")]
    NotFinite {
        /// The joint.
        joint: String,
        /// The value.
        value: f32,
        /// Number of steps so far.
        steps: u64,
    },
    /// The server is older than velocity commands.
    #[error(
        "the endpoint ignores velocity commands: it observes {observed:?} instead of {wanted:?}\n  its server is older than \
         the field `command`; run without a velocity, or install the same Twinstep at both ends"
    )]
    CommandIgnored {
        /// Velocity command in the observation.
        observed: [f32; 3],
        /// Velocity command that was sent.
        wanted: [f32; 3],
    },
    /// The server is older than gait commands.
    #[error(
        "the endpoint ignores gait commands: it observes a step frequency of {observed} Hz instead of {wanted}\n  its server \
         is older than the field `gait_command`; run without gaits, or install the same Twinstep at both ends"
    )]
    GaitCommandIgnored {
        /// Step frequency in the observation [Hz].
        observed: f32,
        /// Step frequency that was sent [Hz].
        wanted: f32,
    },
    /// The log cannot be written.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The robot or the connection failed.
    #[error(transparent)]
    Env(#[from] EnvError),
}

/// Says how a file of PyTorch becomes one of ONNX.
pub fn torch_hint(path: &std::path::Path) -> String {
    if !path.extension().is_some_and(|end| end == "pt" || end == "pth" || end == "jit") {
        return String::new();
    }
    format!(
        "\n  a TorchScript file becomes ONNX in Python, with the length of its observation in place of 45:\n    import torch; \
         torch.onnx.export(torch.jit.load(\"{}\").eval(), (torch.zeros(1, 45),), \"policy.onnx\", dynamo=False)\n  a checkpoint \
         with weights alone (model_1000.pt) is exported by the program that trained it",
        path.display()
    )
}

fn lines(differences: &[SpecDifference]) -> String {
    let line = |SpecDifference { quantity, values: [policy, endpoint] }: &SpecDifference| {
        format!("  {quantity}: the policy has {policy}, the endpoint {endpoint}")
    };
    differences.iter().map(line).collect::<Vec<_>>().join("\n")
}
