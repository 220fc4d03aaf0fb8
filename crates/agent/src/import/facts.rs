//! What one source says about a policy.

use std::collections::BTreeMap;

use crate::mapping::{History, HistoryLayout, HistoryOrder, TermName};

/// Joints of the Go2 in the order of Isaac Gym, MuJoCo and legged_gym: leg by leg.
pub const BY_LEG: [&str; 12] = [
    "FL_hip", "FL_thigh", "FL_calf", "FR_hip", "FR_thigh", "FR_calf", "RL_hip", "RL_thigh", "RL_calf", "RR_hip",
    "RR_thigh", "RR_calf",
];

/// Joints of the Go2 in the order of Isaac Lab: kind by kind, because it walks through the tree breadth first.
pub const BY_KIND: [&str; 12] = [
    "FL_hip", "FR_hip", "RL_hip", "RR_hip", "FL_thigh", "FR_thigh", "RL_thigh", "RR_thigh", "FL_calf", "FR_calf",
    "RL_calf", "RR_calf",
];

/// Joints of the Go2 in the order of its motors.
pub const BY_MOTOR: [&str; 12] = [
    "FR_hip", "FR_thigh", "FR_calf", "FL_hip", "FL_thigh", "FL_calf", "RR_hip", "RR_thigh", "RR_calf", "RL_hip",
    "RL_thigh", "RL_calf",
];

/// A value and the place in its source.
#[derive(Clone, Debug, PartialEq)]
pub struct Found<T> {
    /// The value.
    pub value: T,
    /// The place, such as `deploy.yaml, stiffness`.
    pub place: String,
}

/// A term of the observation.
#[derive(Clone, Debug, PartialEq)]
pub struct TermFacts {
    /// The quantity.
    pub term: TermName,
    /// Name in the source.
    pub name: String,
    /// Factor: nothing for 1, one number, or one for each entry.
    pub scale: Vec<f64>,
    /// Lowest and highest value before the scale.
    pub clip: Option<[f64; 2]>,
    /// Number of steps with the present one, if the term has its own.
    pub history: Option<usize>,
    /// Period of a gait clock [s], and the command below which it stands still.
    pub period: Option<f64>,
    /// As [`TermFacts::period`].
    pub still_below: Option<f64>,
}

impl TermFacts {
    /// Returns a term without scale, clip and history.
    pub fn new(term: TermName, name: &str) -> Self {
        let name = name.to_owned();
        Self { term, name, scale: Vec::new(), clip: None, history: None, period: None, still_below: None }
    }
}

/// Terms and history of an input of the network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InputFacts {
    /// The terms, in order.
    pub terms: Vec<TermFacts>,
    /// Terms that Twinstep does not have, by name.
    pub unknown: Vec<String>,
    /// Earlier observations, if the source says.
    pub history: Option<History>,
}

/// What a source says. Per-joint values are in the order of `joints`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Facts {
    /// The file.
    pub source: String,
    /// Names in the order of the policy, without `_joint`.
    pub joints: Option<Found<Vec<String>>>,
    /// Position gains [N·m/rad].
    pub kp: Option<Found<Vec<f64>>>,
    /// Velocity gains [N·m·s/rad].
    pub kd: Option<Found<Vec<f64>>>,
    /// Joint offsets of an action of 1 [rad].
    pub action_scale: Option<Found<Vec<f64>>>,
    /// Default pose [rad].
    pub default_pose: Option<Found<Vec<f64>>>,
    /// Rate of the policy [Hz].
    pub policy_hz: Option<Found<f64>>,
    /// Lowest and highest output of the network.
    pub action_clip: Option<Found<[f64; 2]>>,
    /// The observation.
    pub observation: Option<Found<InputFacts>>,
    /// True if the source does not contain the order of the observation's terms.
    pub is_order_assumed: bool,
    /// Further inputs by name.
    pub inputs: BTreeMap<String, InputFacts>,
    /// What a reader should know.
    pub notes: Vec<String>,
}

impl Facts {
    /// Returns a value with its place.
    pub fn found<T>(&self, value: T, place: &str) -> Found<T> {
        Found { value, place: format!("{}, {place}", self.source) }
    }

    /// Returns the names of the joints; those of `default` in the order of a program if the source has none.
    pub fn joint_names(&self, default: &[&str; 12]) -> Vec<String> {
        let own = self.joints.as_ref().map(|joints| joints.value.clone());
        own.unwrap_or_else(|| default.map(str::to_owned).to_vec())
    }
}

/// Returns the name of a joint without the ending that robot files add.
pub fn joint_name(name: &str) -> String {
    name.strip_suffix("_joint").unwrap_or(name).to_owned()
}

/// Returns the quantity of a term by its name in Isaac Lab, mjlab, unitree_rl_lab, rl_sar or legged_gym.
pub fn term_name(name: &str) -> Option<TermName> {
    Some(match name {
        "base_lin_vel" | "lin_vel" | "base_linear_velocity" => TermName::BaseLinearVelocity,
        "base_ang_vel" | "ang_vel" | "ang_vel_body" | "base_angular_velocity" | "imu_ang_vel" => {
            TermName::BaseAngularVelocity
        }
        "projected_gravity" | "gravity_vec" | "gravity" => TermName::ProjectedGravity,
        "velocity_commands"
        | "velocity_command"
        | "commands"
        | "command"
        | "generated_commands"
        | "twist"
        | "keyboard_velocity_commands"
        | "base_velocity" => TermName::VelocityCommand,
        "joint_pos_rel" | "dof_pos" => TermName::JointPosition,
        "joint_vel_rel" | "joint_vel" | "dof_vel" => TermName::JointVelocity,
        "last_action" | "actions" | "action" | "prev_action" | "last_actions" | "prev_actions" => {
            TermName::PreviousAction
        }
        "gait_phase" | "phase" => TermName::GaitPhase,
        _ => return None,
    })
}

/// Returns a history of `length` steps; none for one step.
pub fn history(length: usize, layout: HistoryLayout, order: HistoryOrder) -> Option<History> {
    (length > 1).then_some(History { length, layout, order })
}
