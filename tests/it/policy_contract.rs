//! Comparison of a policy's contract with that of the robot, before the policy moves it.

use twinstep_envs::{Task, Walk, WalkConfig};
use twinstep_model::{EnvSpec, go2};
use twinstep_robot::preflight::compare;

fn spec() -> EnvSpec {
    Walk::new(WalkConfig::default(), &go2(), false).unwrap().spec().clone()
}

/// Mistakes in a policy file, each with the finding that names it.
type Change = fn(&mut EnvSpec);
const MISTAKES: [(&str, Change, &str); 10] = [
    ("joints sorted by kind", |spec| spec.joint_order.sort_by_key(|name| name[3..].to_owned()), "policy_joint_order"),
    ("legs in the robot's order", |spec| spec.joint_order.rotate_left(3), "policy_joint_order"),
    ("other action scale", |spec| spec.action_scale = 0.25, "policy_action_scale"),
    ("other default pose", |spec| spec.default_pose[2] = -1.8, "policy_default_pose"),
    ("other position gain", |spec| spec.kp = 40.0, "policy_kp"),
    ("other velocity gain", |spec| spec.kd = 1.0, "policy_kd"),
    (
        "a stiff calf",
        |spec| spec.joint_gains = (0..12).map(|joint| [if joint == 2 { 40.0 } else { 30.0 }, 0.75]).collect(),
        "policy_joint_gains",
    ),
    ("other period", |spec| spec.policy_dt = 0.01, "policy_period"),
    ("observation in another order", |spec| spec.observation.swap(0, 1), "policy_observation"),
    ("action with an entry for each leg", |spec| spec.action[0].size = 4, "policy_action"),
];

#[test]
fn equal_contracts_have_no_finding() {
    assert_eq!(compare(&spec().differences(&spec())), []);
}

#[test]
fn every_mistake_in_a_policy_file_is_named() {
    for (mistake, change, id) in MISTAKES {
        let mut policy = spec();
        change(&mut policy);
        let findings = compare(&policy.differences(&spec()));
        println!("| {mistake} | {id} |");
        assert_eq!(findings.iter().map(|finding| finding.id).collect::<Vec<_>>(), [id], "{mistake}");
        assert!(!findings[0].remedy.is_empty());
    }
}

#[test]
fn all_differences_are_found_with_both_values() {
    let mut policy = spec();
    (policy.kp, policy.kd) = (20.0, 0.5);
    let findings = compare(&policy.differences(&spec()));
    assert_eq!(findings.len(), 2);
    assert_eq!(findings[0].evidence, "`kp` of the policy is 20; that of the robot is 30");
}
