//! A policy of another program: the same network with other joints, scales, pose and history.

use twinstep_agent::{HistoryLayout, HistoryOrder, Mapping, Term, TermName};
use twinstep_policy::{Mlp, Normaliser, Policy};

/// Entry of the present observation in the input of the other network.
struct Entry {
    /// Index in the input of the other network.
    theirs: usize,
    /// Index in our observation.
    ours: usize,
    /// Our value is theirs times `factor` plus `offset`.
    factor: f32,
    offset: f32,
}

/// Returns the policy that gives the robot the commands of `original` through `mapping`, while no action is clipped.
///
/// It ignores the earlier steps of its input.
pub fn foreign_policy(original: &Policy, mapping: &Mapping) -> Policy {
    let entries = entries(original, mapping);
    let sizes: Vec<usize> = [&[mapping.input_len()], &original.actor.sizes()[1..]].concat();
    let mut actor = Mlp::zeros(&sizes);
    let last = actor.layers().len() - 1;
    for index in 0..=last {
        let (mut weight, mut bias) = original.actor.layer(index);
        if index == 0 {
            let hidden = bias.len();
            let mut rows = vec![0.0; mapping.input_len() * hidden];
            for entry in &entries {
                rows[entry.theirs * hidden..][..hidden].copy_from_slice(&weight[entry.ours * hidden..][..hidden]);
            }
            weight = rows;
        }
        if index == last {
            (weight, bias) = output_layer(original, mapping, &weight, &bias);
        }
        actor.set_layer(index, &weight, &bias);
    }
    let (mean, std) = original.normaliser.mean_and_std();
    let (mut their_mean, mut their_std) = (vec![0.0; mapping.input_len()], vec![1.0; mapping.input_len()]);
    for Entry { theirs, ours, factor, offset } in entries {
        their_mean[theirs] = (mean[ours] - offset) / factor;
        their_std[theirs] = std[ours] / factor;
    }
    let normaliser = Normaliser::from_mean_and_std(&their_mean, &their_std);
    Policy { normaliser, actor, ..original.clone() }
}

/// Returns weights and bias of the last layer, in the order and scale of the mapping.
fn output_layer(original: &Policy, mapping: &Mapping, weight: &[f32], bias: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let joints = mapping.joints.len();
    let (mut their_weight, mut their_bias) = (weight.to_vec(), bias.to_vec());
    for theirs in 0..joints {
        let (ours, scale) = (our_joint(original, mapping, theirs), mapping.action_scale.of(theirs));
        let factor = original.spec.action_scale as f32 / scale;
        for row in 0..weight.len() / joints {
            their_weight[row * joints + theirs] = factor * weight[row * joints + ours];
        }
        their_bias[theirs] = factor * bias[ours] + pose_offset(original, mapping, theirs) / scale;
    }
    (their_weight, their_bias)
}

fn our_joint(original: &Policy, mapping: &Mapping, theirs: usize) -> usize {
    original.spec.joint_order.iter().position(|joint| *joint == mapping.joints[theirs]).expect("a joint of the robot")
}

/// Returns our default position of a joint relative to theirs [rad].
fn pose_offset(original: &Policy, mapping: &Mapping, theirs: usize) -> f32 {
    let ours = original.spec.default_pose[our_joint(original, mapping, theirs)];
    (ours - mapping.default_pose[&mapping.joints[theirs]]) as f32
}

fn entries(original: &Policy, mapping: &Mapping) -> Vec<Entry> {
    let joints = mapping.joints.len();
    let action_scale = original.spec.action_scale as f32;
    let mut entries = Vec::new();
    for (index, term) in mapping.observation.iter().enumerate() {
        let start = original.spec.observation_field(term.term.name()).expect("the policy observes it").0;
        for entry in 0..term.len(joints) {
            let scale = term.scale.of(entry);
            let (ours, factor, offset) = match term.term {
                TermName::JointPosition => {
                    (our_joint(original, mapping, entry), 1.0 / scale, -pose_offset(original, mapping, entry))
                }
                TermName::JointVelocity => (our_joint(original, mapping, entry), 1.0 / scale, 0.0),
                TermName::PreviousAction => (
                    our_joint(original, mapping, entry),
                    mapping.action_scale.of(entry) / action_scale / scale,
                    -pose_offset(original, mapping, entry) / action_scale,
                ),
                _ => (entry, 1.0 / scale, 0.0),
            };
            let theirs = present_start(mapping, index) + entry;
            entries.push(Entry { theirs, ours: start + ours, factor, offset });
        }
    }
    entries
}

/// Returns the index of the present values of a term in the input of the network.
fn present_start(mapping: &Mapping, term: usize) -> usize {
    let len = |term: &Term| term.len(mapping.joints.len());
    let before = &mapping.observation[..term];
    let Some(history) = mapping.history else { return before.iter().map(len).sum() };
    let last = |term: &Term| match history.order {
        HistoryOrder::OldestFirst => mapping.steps(term) - 1,
        HistoryOrder::NewestFirst => 0,
    };
    let this = &mapping.observation[term];
    match history.layout {
        HistoryLayout::Terms => {
            before.iter().map(|term| mapping.steps(term) * len(term)).sum::<usize>() + last(this) * len(this)
        }
        HistoryLayout::Frames => {
            let frame: usize = mapping.observation.iter().map(len).sum();
            last(this) * frame + before.iter().map(len).sum::<usize>()
        }
    }
}
