//! A policy of another program, whose observation and action are translated.

use twinstep_model::{EnvSpec, SpecDifference};

use crate::error::AgentError;
use crate::history::ObservationHistory;
use crate::mapping::{Mapping, Term, TermName, steps};
use crate::network_state::NetworkState;
use crate::onnx::OnnxNetwork;
use crate::policy_input::PolicyInput;

/// Part of the group `critic` that a simulator gives for [`TermName::BaseLinearVelocity`].
const TRUE_LINEAR_VELOCITY: &str = "true_linear_velocity";

/// Policy of another program on one robot.
#[derive(Clone, Debug)]
pub struct MappedPolicy {
    network: OnnxNetwork,
    mapping: Mapping,
    observations: Vec<ObservedInput>,
    state: NetworkState,
    /// Index of the output that is the action.
    action: usize,
    /// First entry of the velocity command in the observation of the endpoint, if it has one.
    command: Option<usize>,
    /// Index in the order of the endpoint of each joint of the policy.
    joint: Vec<usize>,
    /// Default pose of policy and endpoint, in the order of the policy [rad].
    default_pose: [Vec<f32>; 2],
    /// Action scale of the endpoint [rad].
    action_scale: f32,
    /// Last output of the network, after `action_clip`.
    previous_action: Vec<f32>,
    /// Number of steps since the reset.
    step: u64,
}

/// An input of the network that is made from observations.
#[derive(Clone, Debug)]
struct ObservedInput {
    /// Index of the input.
    index: usize,
    terms: Vec<Term>,
    /// First entry of each term in the observation of the endpoint; in group `critic` for the linear velocity.
    sources: Vec<usize>,
    history: ObservationHistory,
}

impl MappedPolicy {
    /// Compares the mapping with the endpoint, and prepares the translation.
    pub fn new(network: OnnxNetwork, mapping: Mapping, spec: &EnvSpec) -> Result<Self, AgentError> {
        let joint = joint_indices(&mapping, spec)?;
        check_control(&mapping, &joint, spec)?;
        let (observed, state) = NetworkState::of(&network, &mapping)?;
        let observations = observed
            .into_iter()
            .map(|(index, name)| observed_input(&network, &mapping, (index, name.as_deref()), spec))
            .collect::<Result<_, _>>()?;
        let action = action_output(&network, &mapping)?;
        let theirs = mapping.joints.iter().map(|name| mapping.default_pose[name] as f32).collect();
        let ours = joint.iter().map(|index| spec.default_pose[*index] as f32).collect();
        Ok(Self {
            observations,
            state,
            action,
            command: spec.observation_field(TermName::VelocityCommand.name()).map(|(start, _)| start),
            default_pose: [theirs, ours],
            action_scale: spec.action_scale as f32,
            previous_action: vec![0.0; joint.len()],
            joint,
            network,
            mapping,
            step: 0,
        })
    }

    /// Starts a new episode.
    pub fn reset(&mut self) {
        self.observations.iter_mut().for_each(|input| input.history.clear());
        self.state.reset();
        self.previous_action.fill(0.0);
        self.step = 0;
    }

    /// Returns the action in the order and scale of the endpoint, not clipped to its range.
    pub fn action(&mut self, input: &PolicyInput) -> Result<Vec<f32>, AgentError> {
        let mut values = vec![Vec::new(); self.network.inputs().len()];
        for index in 0..self.observations.len() {
            for term in 0..self.observations[index].terms.len() {
                let value = self.term(&self.observations[index], term, input);
                self.observations[index].history.push(term, value);
            }
            values[self.observations[index].index] = self.observations[index].history.input();
        }
        self.state.write(&mut values);
        let mut outputs = self.network.run(&values.iter().map(Vec::as_slice).collect::<Vec<_>>())?;
        self.state.read(&outputs);
        let mut output = std::mem::take(&mut outputs[self.action]);
        if let Some([low, high]) = self.mapping.action_clip {
            for value in &mut output {
                *value = value.clamp(low, high);
            }
        }
        let mut action = vec![0.0; output.len()];
        let [theirs, ours] = &self.default_pose;
        for (index, value) in output.iter().enumerate() {
            let target = theirs[index] + self.mapping.action_scale.of(index) * value;
            action[self.joint[index]] = (target - ours[index]) / self.action_scale;
        }
        self.previous_action = output;
        self.step += 1;
        Ok(action)
    }

    /// Returns the present values of a term of the policy's observation.
    fn term(&self, observed: &ObservedInput, index: usize, input: &PolicyInput) -> Vec<f32> {
        let (term, start) = (&observed.terms[index], observed.sources[index]);
        let [theirs, ours] = &self.default_pose;
        let joints = || self.joint.iter();
        let mut values: Vec<f32> = match term.term {
            TermName::BaseLinearVelocity => input.critic_obs[start..start + 3].to_vec(),
            TermName::JointPosition => {
                joints().enumerate().map(|(i, joint)| input.obs[start + joint] + ours[i] - theirs[i]).collect()
            }
            TermName::AbsoluteJointPosition => {
                joints().enumerate().map(|(i, joint)| input.obs[start + joint] + ours[i]).collect()
            }
            TermName::JointVelocity => joints().map(|joint| input.obs[start + joint]).collect(),
            TermName::PreviousAction => self.previous_action.clone(),
            TermName::BaseAngularVelocity | TermName::ProjectedGravity | TermName::VelocityCommand => {
                input.obs[start..start + 3].to_vec()
            }
            TermName::GaitPhase => self.gait_phase(term, input),
            TermName::Constant => term.values.clone(),
        };
        for (entry, value) in values.iter_mut().enumerate() {
            let clipped = term.clip.map_or(*value, |[low, high]| value.clamp(low, high));
            *value = term.scale.of(entry) * clipped;
        }
        values
    }

    /// Returns sine and cosine of the clock.
    fn gait_phase(&self, term: &Term, input: &PolicyInput) -> Vec<f32> {
        if let (Some(threshold), Some(start)) = (term.still_below, self.command)
            && input.obs[start..start + 3].iter().map(|value| value * value).sum::<f32>().sqrt() < threshold
        {
            return vec![0.0; 2];
        }
        let cycles = self.step as f64 / self.mapping.policy_hz / term.period.unwrap_or(1.0);
        let (sine, cosine) = (std::f64::consts::TAU * cycles.fract()).sin_cos();
        vec![sine as f32, cosine as f32]
    }
}

/// Returns an input that is made from observations, whose length fits the mapping.
fn observed_input(
    network: &OnnxNetwork,
    mapping: &Mapping,
    (index, name): (usize, Option<&str>),
    spec: &EnvSpec,
) -> Result<ObservedInput, AgentError> {
    let (terms, history) = mapping.terms(name);
    let port = &network.inputs()[index];
    let (given, expected) = (port.len(), mapping.len_of(name));
    if given != expected {
        let size = |term: &Term| {
            let (steps, len) = (steps(term, history), term.len(mapping.joints.len()));
            let times = if steps == 1 { String::new() } else { format!("{steps} x ") };
            format!("{} {times}{len}", term.term.name())
        };
        let terms: Vec<String> = terms.iter().map(size).collect();
        let hint = format!("the mapping has {} for its input `{}`", terms.join(", "), port.name);
        return Err(AgentError::NetworkSize { what: "inputs", given, expected, hint });
    }
    let sources = terms.iter().map(|term| source(term, mapping.joints.len(), spec)).collect::<Result<_, _>>()?;
    Ok(ObservedInput { index, terms: terms.to_vec(), sources, history: ObservationHistory::new(terms, history) })
}

/// Returns the index of the output that is the action: the first one with an entry for each joint.
fn action_output(network: &OnnxNetwork, mapping: &Mapping) -> Result<usize, AgentError> {
    let joints = mapping.joints.len();
    network.outputs().iter().position(|output| output.len() == joints).ok_or_else(|| AgentError::NetworkSize {
        what: "outputs",
        given: network.outputs()[0].len(),
        expected: joints,
        hint: "one for each of `joints` of the mapping".to_owned(),
    })
}

/// Returns the index in the endpoint's order of each joint of the policy. Its names may end with `_joint`.
fn joint_indices(mapping: &Mapping, spec: &EnvSpec) -> Result<Vec<usize>, AgentError> {
    let index = |name: &String| {
        let is_same = |joint: &String| joint == name || Some(joint.as_str()) == name.strip_suffix("_joint");
        spec.joint_order.iter().position(is_same)
    };
    let indices: Option<Vec<usize>> = mapping.joints.iter().map(index).collect();
    indices.filter(|indices| indices.len() == spec.joint_order.len()).ok_or_else(|| AgentError::Disagreement {
        differences: vec![SpecDifference {
            quantity: "joints".to_owned(),
            values: [mapping.joints.join(" "), spec.joint_order.join(" ")],
        }],
        hint: "`joints` of the mapping must have the names of the endpoint, in the order of the policy".to_owned(),
    })
}

/// Compares gains of each joint, and the rate.
fn check_control(mapping: &Mapping, joint: &[usize], spec: &EnvSpec) -> Result<(), AgentError> {
    let mut differences = Vec::new();
    for (quantity, policy, gain) in [("kp", &mapping.kp, 0), ("kd", &mapping.kd, 1)] {
        let theirs: Vec<f64> = (0..joint.len()).map(|index| f64::from(policy.of(index))).collect();
        let ours: Vec<f64> = joint.iter().map(|joint| spec.gains(*joint)[gain]).collect();
        if theirs.iter().zip(&ours).any(|(policy, endpoint)| (policy - endpoint).abs() > 1e-6 * policy) {
            differences.push(SpecDifference { quantity: quantity.to_owned(), values: [short(&theirs), short(&ours)] });
        }
    }
    let (theirs, ours) = (mapping.policy_hz, 1.0 / spec.policy_dt);
    if (theirs - ours).abs() > 1e-6 * theirs {
        let values = [theirs.to_string(), ours.to_string()];
        differences.push(SpecDifference { quantity: "policy_hz".to_owned(), values });
    }
    if differences.is_empty() {
        return Ok(());
    }
    let hint = "start the endpoint with the policy's contract: `--contract MAPPING`, for `twinstep serve` and for \
                `twinstep robot`"
        .to_owned();
    Err(AgentError::Disagreement { differences, hint })
}

/// Returns one number if all are equal, else all of them.
fn short(numbers: &[f64]) -> String {
    match numbers {
        [first, rest @ ..] if rest.iter().all(|number| number == first) => first.to_string(),
        _ => numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" "),
    }
}

/// Returns the first entry of a term in the observation of the endpoint.
fn source(term: &Term, joints: usize, spec: &EnvSpec) -> Result<usize, AgentError> {
    let (field, hint) = match term.term {
        // The policy's own.
        TermName::PreviousAction | TermName::GaitPhase | TermName::Constant => return Ok(0),
        TermName::BaseLinearVelocity => (
            spec.critic_field(TRUE_LINEAR_VELOCITY),
            "only simulators give it, in group `critic`; a robot does not measure it: train without it",
        ),
        TermName::AbsoluteJointPosition => {
            (spec.observation_field(TermName::JointPosition.name()), "serve a task that observes it, such as `walk`")
        }
        _ => (spec.observation_field(term.term.name()), "serve a task that observes it, such as `walk`"),
    };
    let found = field.filter(|(_, field)| field.size == term.len(joints));
    found.map(|(start, _)| start).ok_or_else(|| AgentError::MissingObservation {
        term: term.term.name().to_owned(),
        available: spec.observation.iter().map(|field| field.name.as_str()).collect::<Vec<_>>().join(", "),
        hint,
    })
}
