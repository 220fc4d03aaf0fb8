//! Sources merged: the first that has a value gives it; others are compared with it.

use std::collections::BTreeMap;

use twinstep_model::{Joint, go2};

use super::facts::{Facts, Found, InputFacts, TermFacts};
use crate::mapping::{History, HistoryLayout, HistoryOrder, TermName};
use crate::onnx::OnnxNetwork;

/// Difference of two numbers that counts as none: metadata of networks have three decimals.
const TOLERANCE: f64 = 1e-3;

/// What a mapping needs, as far as it was found.
#[derive(Clone, Debug, Default)]
pub struct Draft {
    /// Names in the order of the policy.
    pub joints: Option<Vec<String>>,
    /// Values per joint, in the order of `joints`.
    pub per_joint: BTreeMap<&'static str, Vec<f64>>,
    /// Rate of the policy [Hz].
    pub policy_hz: Option<f64>,
    /// Lowest and highest output of the network.
    pub action_clip: Option<[f64; 2]>,
    /// The observation.
    pub observation: Option<InputFacts>,
    /// True if no source contains the order of the observation's terms.
    pub is_order_assumed: bool,
    /// Further inputs of the network.
    pub inputs: BTreeMap<String, InputFacts>,
    /// As in `ImportedPolicy`.
    pub origins: Vec<(String, String)>,
    /// As in `ImportedPolicy`.
    pub missing: Vec<String>,
    /// As in `ImportedPolicy`.
    pub disagreements: Vec<String>,
    /// As in `ImportedPolicy`.
    pub notes: Vec<String>,
}

/// Keys with a number for each joint, with what one has to look for if they are missing.
pub const PER_JOINT: [(&str, &str); 4] = [
    ("action_scale", "joint offset of an action of 1 [rad]"),
    ("kp", "position gain of the training [N·m/rad]"),
    ("kd", "velocity gain of the training [N·m·s/rad]"),
    ("default_pose", "joint positions at an action of 0 [rad]"),
];

fn values<'a>(facts: &'a Facts, key: &str) -> Option<&'a Found<Vec<f64>>> {
    match key {
        "action_scale" => facts.action_scale.as_ref(),
        "kp" => facts.kp.as_ref(),
        "kd" => facts.kd.as_ref(),
        _ => facts.default_pose.as_ref(),
    }
}

impl Draft {
    /// Merges what sources say, and compares it with the network.
    pub fn new(sources: Vec<Facts>, network: Option<&OnnxNetwork>) -> Self {
        let mut draft = Self::default();
        draft.merge_joints(&sources);
        for (key, what) in PER_JOINT {
            draft.merge_per_joint(key, what, &sources);
        }
        let rate = draft.first("policy_hz", sources.iter().map(|facts| facts.policy_hz.as_ref()), |one, other| {
            (one - other).abs() <= TOLERANCE * one.abs()
        });
        draft.policy_hz = rate;
        if draft.policy_hz.is_none() {
            draft.missing.push("policy_hz: rate of the policy [Hz]".to_owned());
        }
        draft.action_clip =
            draft.first("action_clip", sources.iter().map(|facts| facts.action_clip.as_ref()), |_, _| true);
        let observations = sources.iter().map(|facts| facts.observation.as_ref());
        draft.observation = draft.first("observation", observations, same_terms);
        draft.inputs =
            sources.iter().find(|facts| !facts.inputs.is_empty()).map(|facts| facts.inputs.clone()).unwrap_or_default();
        draft.notes.extend(sources.iter().flat_map(|facts| facts.notes.clone()));
        draft.check_terms();
        if let Some(network) = network {
            draft.compare(network);
        }
        let of_observation = sources.iter().find(|facts| facts.observation.is_some());
        draft.is_order_assumed = of_observation.is_some_and(|facts| facts.is_order_assumed);
        draft
    }

    /// Returns the value of the first source that has one, and names those of others that differ.
    fn first<'a, T: Clone + std::fmt::Debug + 'a>(
        &mut self,
        key: &str,
        found: impl Iterator<Item = Option<&'a Found<T>>>,
        same: impl Fn(&T, &T) -> bool,
    ) -> Option<T> {
        let mut found = found.flatten();
        let first = found.next()?;
        self.origins.push((key.to_owned(), first.place.clone()));
        for other in found.filter(|other| !same(&first.value, &other.value)) {
            self.disagreements.push(format!("{key}: {} and {} differ; the first is taken", first.place, other.place));
        }
        Some(first.value.clone())
    }

    fn merge_joints(&mut self, sources: &[Facts]) {
        let joints = self.first("joints", sources.iter().map(|facts| facts.joints.as_ref()), |one, other| one == other);
        if joints.is_none() {
            self.missing.push("joints: names of the joints in the order of the policy".to_owned());
        }
        self.joints = joints;
    }

    fn merge_per_joint(&mut self, key: &'static str, what: &str, sources: &[Facts]) {
        let Some(joints) = self.joints.clone() else {
            let known = sources.iter().find_map(|facts| values(facts, key));
            let what = known.map_or_else(
                || what.to_owned(),
                |found| format!("{} has numbers, but the order of the joints is not known; name them", found.place),
            );
            self.missing.push(format!("{key}: {what}"));
            return;
        };
        let mut first: Option<(Vec<f64>, String)> = None;
        for facts in sources {
            let Some(found) = values(facts, key) else { continue };
            let own = facts.joints.as_ref().map_or(&joints, |own| &own.value);
            let by_name = |joint: &String| {
                let index = own.iter().position(|name| name == joint)?;
                if found.value.len() == 1 { found.value.first().copied() } else { found.value.get(index).copied() }
            };
            let ordered: Option<Vec<f64>> = joints.iter().map(by_name).collect();
            let Some(ordered) = ordered.filter(|_| found.value.len() == 1 || found.value.len() == own.len()) else {
                self.disagreements.push(format!(
                    "{key}: {} has {} numbers for {} joints; it is left out",
                    found.place,
                    found.value.len(),
                    own.len()
                ));
                continue;
            };
            match &first {
                None => first = Some((ordered, found.place.clone())),
                Some((values, place)) => {
                    let differs = |joint: &usize| {
                        (values[*joint] - ordered[*joint]).abs() > TOLERANCE * values[*joint].abs().max(1.0)
                    };
                    if let Some(joint) = (0..joints.len()).find(differs) {
                        self.disagreements.push(format!(
                            "{key}: {} of {} is {}, but {} has {}; the first is taken",
                            place, joints[joint], values[joint], found.place, ordered[joint]
                        ));
                    }
                }
            }
        }
        let outside =
            first.as_ref().filter(|_| key == "default_pose").and_then(|(pose, _)| outside_range(&joints, pose));
        if let Some(outside) = outside {
            self.missing.push(format!("{key}: {outside}"));
            return;
        }
        match first {
            Some((values, place)) => {
                self.origins.push((key.to_owned(), place));
                self.per_joint.insert(key, values);
            }
            None => self.missing.push(format!("{key}: {what}")),
        }
    }

    fn check_terms(&mut self) {
        let Some(input) = &self.observation else {
            self.missing.push("observation: a table [[observation]] for each term, in order (docs/run.md)".to_owned());
            return;
        };
        let inputs = std::iter::once(input).chain(self.inputs.values());
        for name in inputs.flat_map(|input| &input.unknown) {
            self.missing.push(format!(
                "observation: `{name}` is a quantity that no endpoint gives; put a term `constant` with its usual values in its place, \
                 if the policy can do without it"
            ));
        }
        for term in input.terms.iter().filter(|term| term.term == TermName::GaitPhase && term.period.is_none()) {
            self.missing.push(format!("observation: `period` of `{}`, the time of a gait cycle [s]", term.name));
        }
        if input.terms.iter().any(|term| term.term == TermName::BaseLinearVelocity) {
            self.notes.push(
                "it observes the linear velocity of the base, which simulators give and a robot does not".to_owned(),
            );
        }
    }

    /// Compares sizes of the network with those of the observation and the joints.
    fn compare(&mut self, network: &OnnxNetwork) {
        let Some(joints) = self.joints.as_ref().map(Vec::len) else { return };
        if !network.outputs().iter().any(|output| output.len() == joints) {
            self.disagreements.push(format!(
                "joints: the network's outputs have {} numbers, the sources have {joints} joints",
                network.outputs().iter().map(|output| output.len().to_string()).collect::<Vec<_>>().join(", ")
            ));
        }
        let Some(input) = self.observation.clone().filter(|input| input.unknown.is_empty()) else { return };
        let one = step_len(&input, joints);
        let found = total_len(&input, joints);
        let main = network.inputs().iter().find(|port| port.len() == found && !self.inputs.contains_key(&port.name));
        if main.is_none() {
            let port = &network.inputs()[0];
            let places =
                || format!("the network reads {} numbers, the observation of the sources has {found}", port.len());
            if one > 0 && port.len().is_multiple_of(one) && input.terms.iter().all(|term| term.history.is_none()) {
                let steps = port.len() / one;
                let known = input.history.unwrap_or(History {
                    length: 1,
                    layout: HistoryLayout::Terms,
                    order: HistoryOrder::OldestFirst,
                });
                self.disagreements.push(format!("history: {}; {steps} steps are taken", places()));
                let changed = (steps > 1).then_some(History { length: steps, ..known });
                self.observation = Some(InputFacts { history: changed, ..input.clone() });
            } else {
                self.disagreements.push(format!("observation: {}", places()));
            }
        }
        // Further inputs: a state, which an output of its shape follows, or more of the observation.
        let main = main.unwrap_or(&network.inputs()[0]).name.clone();
        let mut outputs: Vec<_> = network.outputs().iter().skip(1).collect();
        for port in network.inputs() {
            if port.name == main || self.inputs.contains_key(&port.name) {
                continue;
            }
            if let Some(follower) = outputs.iter().position(|output| output.shape == port.shape) {
                self.notes.push(format!(
                    "the network keeps a state: `{}` becomes `{}`",
                    port.name,
                    outputs.remove(follower).name
                ));
            } else if one > 0 && port.len() % one == 0 {
                let length = port.len() / one;
                self.notes.push(format!(
                    "the sources do not say what the input `{}` is: {} taken; compare it with the program that trained it",
                    port.name,
                    if length == 1 {
                        "the present observation is".to_owned()
                    } else {
                        format!("the last {length} observations are, one step after the other, the oldest first,")
                    }
                ));
                let history = (length > 1).then_some(History {
                    length,
                    layout: HistoryLayout::Frames,
                    order: HistoryOrder::OldestFirst,
                });
                self.inputs.insert(port.name.clone(), InputFacts { history, ..InputFacts::default() });
            } else {
                self.missing.push(format!(
                    "input.{}: what its {} numbers are ([input.{}], docs/run.md)",
                    port.name,
                    port.len(),
                    port.name
                ));
            }
        }
    }
}

/// Says which joint a pose puts outside the range of the Go2.
fn outside_range(joints: &[String], pose: &[f64]) -> Option<String> {
    let robot = go2();
    joints.iter().zip(pose).find_map(|(name, q)| {
        let [low, high] = robot.joints[name.parse::<Joint>().ok()?.index()].range;
        (!(low..=high).contains(q)).then(|| {
            format!(
                "{name} = {q} is outside the range of the Go2, {low:.2} to {high:.2} rad: the config is that of another robot, or its \
                 joints have another order"
            )
        })
    })
}

fn same_terms(one: &InputFacts, other: &InputFacts) -> bool {
    let scale = |term: &TermFacts| term.scale.first().copied().unwrap_or(1.0);
    // Metadata has no scales.
    let has_scales = other.terms.iter().any(|term| !term.scale.is_empty());
    one.terms.len() == other.terms.len()
        && one
            .terms
            .iter()
            .zip(&other.terms)
            .all(|(a, b)| a.term == b.term && (!has_scales || (scale(a) - scale(b)).abs() < TOLERANCE))
}

fn term_len(term: &TermFacts, joints: usize) -> usize {
    match term.term {
        TermName::JointPosition
        | TermName::AbsoluteJointPosition
        | TermName::JointVelocity
        | TermName::PreviousAction => joints,
        TermName::GaitPhase => 2,
        _ => 3,
    }
}

fn step_len(input: &InputFacts, joints: usize) -> usize {
    input.terms.iter().map(|term| term_len(term, joints)).sum()
}

fn total_len(input: &InputFacts, joints: usize) -> usize {
    let steps = |term: &TermFacts| term.history.or(input.history.map(|history| history.length)).unwrap_or(1);
    input.terms.iter().map(|term| steps(term) * term_len(term, joints)).sum()
}
