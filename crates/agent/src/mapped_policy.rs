//! A policy of another program, whose observation and action are translated.

use twinstep_model::{EnvSpec, SpecDifference};

use crate::error::AgentError;
use crate::history::ObservationHistory;
use crate::mapping::{Mapping, Term, TermName};
use crate::onnx::OnnxNetwork;
use crate::policy_input::PolicyInput;

/// Part of the group `critic` that a simulator gives for [`TermName::BaseLinearVelocity`].
const TRUE_LINEAR_VELOCITY: &str = "true_linear_velocity";

/// Policy of another program on one robot.
#[derive(Clone, Debug)]
pub struct MappedPolicy {
    network: OnnxNetwork,
    mapping: Mapping,
    /// First entry of each term in the observation of the endpoint; in group `critic` for the linear velocity.
    sources: Vec<usize>,
    /// Index in the order of the endpoint of each joint of the policy.
    joint: Vec<usize>,
    /// Default pose of policy and endpoint, in the order of the policy [rad].
    default_pose: [Vec<f32>; 2],
    /// Action scale of the endpoint [rad].
    action_scale: f32,
    history: ObservationHistory,
    /// Last output of the network.
    previous_action: Vec<f32>,
}

impl MappedPolicy {
    /// Compares the mapping with the endpoint, and prepares the translation.
    pub fn new(network: OnnxNetwork, mapping: Mapping, spec: &EnvSpec) -> Result<Self, AgentError> {
        let joint = joint_indices(&mapping, spec)?;
        check_control(&mapping, spec)?;
        check_sizes(&network, &mapping)?;
        let sources = mapping.observation.iter().map(|term| source(term.term, spec)).collect::<Result<_, _>>()?;
        let theirs = mapping.joints.iter().map(|name| mapping.default_pose[name] as f32).collect();
        let ours = joint.iter().map(|index| spec.default_pose[*index] as f32).collect();
        Ok(Self {
            sources,
            default_pose: [theirs, ours],
            action_scale: spec.action_scale as f32,
            history: ObservationHistory::new(&mapping),
            previous_action: vec![0.0; joint.len()],
            joint,
            network,
            mapping,
        })
    }

    /// Starts a new episode.
    pub fn reset(&mut self) {
        self.history.clear();
        self.previous_action.fill(0.0);
    }

    /// Returns the action in the order and scale of the endpoint, not clipped.
    pub fn action(&mut self, input: &PolicyInput) -> Result<Vec<f32>, AgentError> {
        for index in 0..self.sources.len() {
            let values = self.term(index, input);
            self.history.push(index, values);
        }
        let output = self.network.run(&self.history.input())?;
        let mut action = vec![0.0; output.len()];
        let [theirs, ours] = &self.default_pose;
        for (index, value) in output.iter().enumerate() {
            let target = theirs[index] + self.mapping.action_scale.of(index) * value;
            action[self.joint[index]] = (target - ours[index]) / self.action_scale;
        }
        self.previous_action = output;
        Ok(action)
    }

    /// Returns the present values of a term of the policy's observation.
    fn term(&self, index: usize, input: &PolicyInput) -> Vec<f32> {
        let (term, start) = (&self.mapping.observation[index], self.sources[index]);
        let [theirs, ours] = &self.default_pose;
        let joints = || self.joint.iter();
        let mut values: Vec<f32> = match term.term {
            TermName::BaseLinearVelocity => input.critic_obs[start..start + 3].to_vec(),
            TermName::JointPosition => {
                joints().enumerate().map(|(i, joint)| input.obs[start + joint] + ours[i] - theirs[i]).collect()
            }
            TermName::JointVelocity => joints().map(|joint| input.obs[start + joint]).collect(),
            TermName::PreviousAction => self.previous_action.clone(),
            TermName::BaseAngularVelocity | TermName::ProjectedGravity | TermName::VelocityCommand => {
                input.obs[start..start + 3].to_vec()
            }
        };
        for (entry, value) in values.iter_mut().enumerate() {
            let clipped = term.clip.map_or(*value, |[low, high]| value.clamp(low, high));
            *value = term.scale.of(entry) * clipped;
        }
        values
    }
}

/// Returns the index in the endpoint's order of each joint of the policy.
fn joint_indices(mapping: &Mapping, spec: &EnvSpec) -> Result<Vec<usize>, AgentError> {
    let index = |name: &String| spec.joint_order.iter().position(|joint| joint == name);
    let indices: Option<Vec<usize>> = mapping.joints.iter().map(index).collect();
    indices.filter(|indices| indices.len() == spec.joint_order.len()).ok_or_else(|| AgentError::Disagreement {
        differences: vec![SpecDifference {
            quantity: "joints".to_owned(),
            values: [mapping.joints.join(" "), spec.joint_order.join(" ")],
        }],
        hint: "`joints` of the mapping must have the names of the endpoint, in the order of the policy".to_owned(),
    })
}

/// Compares gains and rate. An endpoint has one gain for all joints.
fn check_control(mapping: &Mapping, spec: &EnvSpec) -> Result<(), AgentError> {
    let pairs = [
        ("kp", mapping.kp, spec.kp),
        ("kd", mapping.kd, spec.kd),
        ("policy_hz", mapping.policy_hz, 1.0 / spec.policy_dt),
    ];
    let differences: Vec<SpecDifference> = pairs
        .iter()
        .filter(|(_, policy, endpoint)| (policy - endpoint).abs() > 1e-6 * policy)
        .map(|(quantity, policy, endpoint)| SpecDifference {
            quantity: (*quantity).to_owned(),
            values: [policy.to_string(), endpoint.to_string()],
        })
        .collect();
    if differences.is_empty() {
        return Ok(());
    }
    let hint = format!(
        "serve the robot with a model file that has\n    [control]\n    kp = {:?}\n    kd = {:?}\n    policy_hz = {:?}",
        mapping.kp, mapping.kd, mapping.policy_hz
    );
    Err(AgentError::Disagreement { differences, hint })
}

fn check_sizes(network: &OnnxNetwork, mapping: &Mapping) -> Result<(), AgentError> {
    let size = |term: &Term| {
        let (steps, len) = (mapping.steps(term), term.term.len(mapping.joints.len()));
        let times = if steps == 1 { String::new() } else { format!("{steps} x ") };
        format!("{} {times}{len}", term.term.name())
    };
    let terms: Vec<String> = mapping.observation.iter().map(size).collect();
    for (what, given, expected, hint) in [
        ("inputs", network.inputs(), mapping.input_len(), format!("the mapping has {}", terms.join(", "))),
        ("outputs", network.outputs(), mapping.joints.len(), "one for each of `joints` of the mapping".to_owned()),
    ] {
        if given != expected {
            return Err(AgentError::NetworkSize { what, given, expected, hint });
        }
    }
    Ok(())
}

/// Returns the first entry of a term in the observation of the endpoint.
fn source(term: TermName, spec: &EnvSpec) -> Result<usize, AgentError> {
    let joints = spec.joint_order.len();
    let (field, hint) = match term {
        // The policy's own.
        TermName::PreviousAction => return Ok(0),
        TermName::BaseLinearVelocity => (
            spec.critic_field(TRUE_LINEAR_VELOCITY),
            "only simulators give it, in group `critic`; a robot does not measure it: train without it",
        ),
        _ => (spec.observation_field(term.name()), "serve a task that observes it, such as `walk`"),
    };
    let found = field.filter(|(_, field)| field.size == term.len(joints));
    found.map(|(start, _)| start).ok_or_else(|| AgentError::MissingObservation {
        term: term.name().to_owned(),
        available: spec.observation.iter().map(|field| field.name.as_str()).collect::<Vec<_>>().join(", "),
        hint,
    })
}
