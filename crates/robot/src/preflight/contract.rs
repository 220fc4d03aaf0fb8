//! Comparison of what a policy expects with what the robot has.

use twinstep_model::SpecDifference;

use super::finding::{Blocks, Finding};

/// What a wrong quantity does, and how it is mended, for each quantity in which a policy can differ from the robot.
const QUANTITIES: [(&str, &str, &str, &str); 12] = [
    (
        "robot",
        "policy_robot",
        "the policy was trained for another robot",
        "use a policy that was trained for this robot, or state its model file by `--model`",
    ),
    (
        "observation",
        "policy_observation",
        "the policy reads another observation than the robot gives",
        "build the observation in the policy's order and sizes, or run the task that it was trained for",
    ),
    (
        "action",
        "policy_action",
        "the policy's action has another layout than the robot's",
        "map every entry of the action to its joint, by name",
    ),
    (
        "joint_order",
        "policy_joint_order",
        "the policy has the joints in another order than the robot",
        "map joints by their names; exports of Isaac Lab are sorted by joint kind (`joint_ids_map` in deploy.yaml)",
    ),
    (
        "policy_dt",
        "policy_period",
        "the policy was trained with another period than the robot's",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.policy_hz` to its rate",
    ),
    (
        "joints",
        "policy_joint_order",
        "the policy has other joints than the robot",
        "give `joints` of the mapping the names of the robot's joints",
    ),
    (
        "policy_hz",
        "policy_period",
        "the policy was trained with another period than the robot's",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.policy_hz` to its rate",
    ),
    (
        "joint_gains",
        "policy_joint_gains",
        "the policy was trained with other gains of single joints",
        "start `twinstep robot` with the policy's contract (`--contract`)",
    ),
    (
        "kp",
        "policy_kp",
        "the policy was trained with another position gain",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.kp` to the gain of the training",
    ),
    (
        "kd",
        "policy_kd",
        "the policy was trained with another velocity gain",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.kd` to the gain of the training",
    ),
    (
        "action_scale",
        "policy_action_scale",
        "an action of 1 is another angle for the policy than for the robot",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.action_scale` to that of the training",
    ),
    (
        "default_pose",
        "policy_default_pose",
        "the policy's actions are relative to another pose than the robot's",
        "start `twinstep robot` with the policy's contract (`--contract`), or set `control.default_pose` to that of the training",
    ),
];

/// Returns a finding for each quantity in which the contract of a policy differs from that of the robot.
pub fn compare(differences: &[SpecDifference]) -> Vec<Finding> {
    let findings = differences.iter().filter_map(|difference| {
        let (_, id, what, remedy) = QUANTITIES.into_iter().find(|(name, ..)| *name == difference.quantity)?;
        let [of_policy, of_robot] = &difference.values;
        let evidence =
            format!("`{}` of the policy is {of_policy}; that of the robot is {of_robot}", difference.quantity);
        Some(Finding::new(id, what.to_owned(), evidence, remedy).blocking(Blocks::Stance))
    });
    findings.collect()
}
